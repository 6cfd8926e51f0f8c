// A buffer that grows and never shrinks: aligned for vectors, not initialised, for plain data only.
#pragma once

#include <cstddef>
#include <cstdint>
#include <new>

namespace splash {

template <class T>
class Buffer {
  public:
    Buffer() = default;
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    ~Buffer() { drop(); }

    // Room for `count` elements; what was there is lost where it had to grow.
    T* fit(size_t count) {
        if (count > capacity_) {
            drop();
            const size_t roomy = count + count / 8 + 16;
            data_ = static_cast<T*>(::operator new(roomy * sizeof(T), std::align_val_t(ALIGNMENT)));
            capacity_ = roomy;
        }
        return data_;
    }

    T* data() { return data_; }
    const T* data() const { return data_; }
    T& operator[](size_t i) { return data_[i]; }
    const T& operator[](size_t i) const { return data_[i]; }
    size_t bytes() const { return capacity_ * sizeof(T); }

    void swap(Buffer& other) {
        T* const data = data_;
        const size_t capacity = capacity_;
        data_ = other.data_;
        capacity_ = other.capacity_;
        other.data_ = data;
        other.capacity_ = capacity;
    }

  private:
    static constexpr size_t ALIGNMENT = 64;

    void drop() {
        if (data_ != nullptr) ::operator delete(data_, std::align_val_t(ALIGNMENT));
        data_ = nullptr;
        capacity_ = 0;
    }

    T* data_ = nullptr;
    size_t capacity_ = 0;
};

// The first place in a caller's memory that vectors may start at; so many floats more hold what is asked for.
constexpr int64_t ALIGNMENT_FLOATS = 16;
template <class T>
T* aligned(T* at) {
    const uintptr_t bytes = ALIGNMENT_FLOATS * sizeof(T);
    return reinterpret_cast<T*>((reinterpret_cast<uintptr_t>(at) + bytes - 1) / bytes * bytes);
}

}  // namespace splash
