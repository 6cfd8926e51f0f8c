// SSIM of two images and its gradient, a row at a time (ssim.py has the formula).
//
// A row of an image is taken as it lies in memory, channel beside channel: neighbours along it are `channels` floats apart.
// Blurs go down the columns first, from the 11 rows around the one at hand, and then along the row that this gives, which
// has zeros at either end. What SSIM's derivatives are by three of the blurs is kept for 11 rows, and blurred likewise.
//
// Each product and each sum is rounded for itself, in the order in which it stands here: this file is compiled without
// multiply-adds (build_compilers.py). So results are the same bits on every processor, and on any number of threads.

#include "ssim.h"

#include <algorithm>
#include <cstring>

#include "native/buffer.h"
#include "native/simd.h"
#include "native/threads.h"

namespace splash {
namespace {

constexpr int RADIUS = 5;
constexpr int TAPS = 2 * RADIUS + 1;
// What is blurred of two images a and b: a, a a, a b, b, b b. Derivatives: by the first three.
constexpr int BLURS = 5, DERIVATIVES = 3;
// Rows that a piece has at the least, as its neighbours' derivatives 5 rows beyond it are computed anew.
constexpr int LEAST_ROWS = 64;
constexpr int PIECES_PER_THREAD = 4;

inline int whole_vectors(int count) { return (count + LANES - 1) / LANES * LANES; }

// Rows by number, of which the last TAPS are kept; numbers may be negative, from -TAPS on.
class Rows {
  public:
    void fit(int length) {
        length_ = length;
        values_.fit(static_cast<size_t>(TAPS) * length);
    }
    float* operator[](int number) { return values_.data() + static_cast<size_t>((number + TAPS) % TAPS) * length_; }

  private:
    Buffer<float> values_;
    int length_ = 0;
};

// What one thread works with.
struct Scratch {
    Rows image, truth, derivatives[DERIVATIVES];
    Buffer<float> blurred, values;
};

class Band {
  public:
    Band(const SplashSsim& images, Scratch& scratch)
        : in_(images),
          scratch_(scratch),
          used_(images.channels * images.width),
          length_(whole_vectors(used_)),
          pad_(RADIUS * images.channels),
          padded_(pad_ + length_ + pad_ + LANES),
          size_(static_cast<float>(static_cast<double>(images.height) * used_)) {
        scratch.image.fit(length_);
        scratch.truth.fit(length_);
        for (Rows& rows : scratch.derivatives) rows.fit(length_);
        scratch.values.fit(length_);
        float* const blurred = scratch.blurred.fit(static_cast<size_t>(BLURS) * padded_);
        std::fill(blurred, blurred + static_cast<size_t>(BLURS) * padded_, 0.0f);
    }

    // The rows [top, bottom): gradient, and by row and channel the sums of SSIM.
    void work(int top, int bottom, double* sums, float* gradient) {
        for (int y = top - 2 * RADIUS; y < top; ++y) read(y);
        for (int y = top - RADIUS; y < bottom + RADIUS; ++y) {
            read(y + RADIUS);
            compare(y, y >= top && y < bottom ? sums + static_cast<int64_t>(y) * in_.channels : nullptr);
            if (y - RADIUS >= top) derive(y - RADIUS, gradient + static_cast<int64_t>(y - RADIUS) * used_);
        }
    }

  private:
    bool has(int y) const { return y >= 0 && y < in_.height; }

    float* padded(int blur) { return scratch_.blurred.data() + static_cast<size_t>(blur) * padded_; }

    // The window, each tap in all lanes.
    struct Window {
        Floats taps[TAPS];
    };
    Window window() const {
        Window window;
        for (int tap = 0; tap < TAPS; ++tap) window.taps[tap] = all(in_.window[tap]);
        return window;
    }

    // Row y of both images, zeros where there is none.
    void read(int y) {
        float* const image = scratch_.image[y];
        float* const truth = scratch_.truth[y];
        const int used = has(y) ? used_ : 0;
        std::fill(image + used, image + length_, 0.0f);
        std::fill(truth + used, truth + length_, 0.0f);
        if (used == 0) return;
        const float* const shown = in_.image + y * in_.stride;
        if (in_.weight == nullptr) {
            std::memcpy(image, shown, sizeof(float) * used);
        } else {
            const float* const weight = in_.weight + static_cast<int64_t>(y) * in_.width;
            for (int x = 0, i = 0; x < in_.width; ++x) {
                for (int channel = 0; channel < in_.channels; ++channel, ++i) image[i] = shown[i] * weight[x];
            }
        }
        if (in_.truth != nullptr) {
            std::memcpy(truth, in_.truth + static_cast<int64_t>(y) * used, sizeof(float) * used);
        } else {
            const uint8_t* const bytes = in_.truth_bytes + static_cast<int64_t>(y) * used;
            for (int i = 0; i < used; ++i) truth[i] = static_cast<float>(bytes[i]) / 255.0f;
        }
    }

    // SSIM's derivatives by the blurs around row y; sums: null, or where SSIM's sums by channel go.
    void compare(int y, double* sums) {
        if (!has(y)) {
            for (Rows& rows : scratch_.derivatives) std::fill(rows[y], rows[y] + length_, 0.0f);
            return;
        }
        blur_down(y);
        float* const by_mean = scratch_.derivatives[0][y];
        float* const by_square = scratch_.derivatives[1][y];
        float* const by_product = scratch_.derivatives[2][y];
        float* const values = scratch_.values.data();
        const Floats one = all(1.0f), two = all(2.0f), c1 = all(in_.c1), c2 = all(in_.c2);
        const Window weights = window();
        for (int i = 0; i < length_; i += LANES) {
            Floats moments[BLURS];
            along<BLURS>(weights, i, moments);
            const Floats mean_a = moments[0], square_a = moments[1], product = moments[2], mean_b = moments[3];
            const Floats squares = mean_a * mean_a + mean_b * mean_b;
            const Floats luminance = two * mean_a * mean_b + c1;
            const Floats structure = two * (product - mean_a * mean_b) + c2;
            const Floats by_means = one / (squares + c1);
            const Floats by_variances = one / (square_a + moments[4] - squares + c2);
            const Floats value = luminance * structure * by_means * by_variances;
            store(values + i, value);
            store(by_mean + i, two * mean_b * (structure - luminance) * by_means * by_variances -
                                   two * mean_a * value * (by_means - by_variances));
            store(by_square + i, -value * by_variances);
            store(by_product + i, two * luminance * by_means * by_variances);
        }
        for (Rows& rows : scratch_.derivatives) std::fill(rows[y] + used_, rows[y] + length_, 0.0f);
        if (sums == nullptr) return;
        for (int channel = 0; channel < in_.channels; ++channel) sums[channel] = 0.0;
        for (int i = 0; i < used_; i += in_.channels) {
            for (int channel = 0; channel < in_.channels; ++channel) sums[channel] += values[i + channel];
        }
    }

    // The gradient of row y, whose derivatives and those of its neighbours are there.
    void derive(int y, float* gradient) {
        const float* rows[DERIVATIVES][TAPS];
        for (int which = 0; which < DERIVATIVES; ++which) {
            for (int tap = 0; tap < TAPS; ++tap) rows[which][tap] = scratch_.derivatives[which][y + tap - RADIUS];
        }
        const Window weights = window();
        for (int i = 0; i < length_; i += LANES) {
            Floats sums[DERIVATIVES] = {};
            for (int tap = 0; tap < TAPS; ++tap) {
                for (int which = 0; which < DERIVATIVES; ++which) sums[which] += weights.taps[tap] * load(rows[which][tap] + i);
            }
            for (int which = 0; which < DERIVATIVES; ++which) store_anywhere(padded(which) + pad_ + i, sums[which]);
        }
        const float* const image = scratch_.image[y];
        const float* const truth = scratch_.truth[y];
        float* const out = scratch_.values.data();
        const Floats two = all(2.0f);
        for (int i = 0; i < length_; i += LANES) {
            Floats by[DERIVATIVES];
            along<DERIVATIVES>(weights, i, by);
            store(out + i, by[0] + (two * load(image + i) * by[1] + load(truth + i) * by[2]));
        }
        if (in_.weight == nullptr) {
            for (int i = 0; i < used_; ++i) gradient[i] = out[i] / size_;
            return;
        }
        const float* const weight = in_.weight + static_cast<int64_t>(y) * in_.width;
        for (int x = 0, i = 0; x < in_.width; ++x) {
            for (int channel = 0; channel < in_.channels; ++channel, ++i) gradient[i] = out[i] * weight[x] / size_;
        }
    }

    // Down the columns around row y, into the padded rows.
    void blur_down(int y) {
        const float* image[TAPS];
        const float* truth[TAPS];
        for (int tap = 0; tap < TAPS; ++tap) {
            image[tap] = scratch_.image[y + tap - RADIUS];
            truth[tap] = scratch_.truth[y + tap - RADIUS];
        }
        const Window weights = window();
        for (int i = 0; i < length_; i += LANES) {
            Floats sums[BLURS] = {};
            for (int tap = 0; tap < TAPS; ++tap) {
                const Floats weight = weights.taps[tap], a = load(image[tap] + i), b = load(truth[tap] + i);
                sums[0] += weight * a;
                sums[1] += weight * (a * a);
                sums[2] += weight * (a * b);
                sums[3] += weight * b;
                sums[4] += weight * (b * b);
            }
            for (int blur = 0; blur < BLURS; ++blur) store_anywhere(padded(blur) + pad_ + i, sums[blur]);
        }
    }

    // Along COUNT padded rows, around the floats from number i on.
    template <int COUNT>
    void along(const Window& weights, int i, Floats* sums) {
        for (int which = 0; which < COUNT; ++which) sums[which] = Floats{};
        for (int tap = 0; tap < TAPS; ++tap) {
            const float* const at = scratch_.blurred.data() + i + tap * in_.channels;
            for (int which = 0; which < COUNT; ++which) {
                sums[which] += weights.taps[tap] * load_anywhere(at + static_cast<size_t>(which) * padded_);
            }
        }
    }

    const SplashSsim& in_;
    Scratch& scratch_;
    int used_, length_, pad_, padded_;
    float size_;
};

}  // namespace

void ssim(const SplashSsim& images, double* totals, float* gradient, int threads) {
    Buffer<double> sums;
    sums.fit(static_cast<size_t>(images.height) * images.channels);
    const int rows =
        threads == 1 ? images.height : std::max(LEAST_ROWS, images.height / (threads * PIECES_PER_THREAD) + 1);
    in_pieces(threads, images.height, rows, [&](int64_t begin, int64_t end, int) {
        static thread_local Scratch scratch;
        Band(images, scratch).work(static_cast<int>(begin), static_cast<int>(end), sums.data(), gradient);
    });
    for (int channel = 0; channel < images.channels; ++channel) {
        totals[channel] = 0.0;
        for (int y = 0; y < images.height; ++y) totals[channel] += sums[static_cast<int64_t>(y) * images.channels + channel];
    }
}

}  // namespace splash
