// Each model stands here once, for writing and for reading: a writer's questions are answered by the numbers that it is
// given, a reader's by the code.

#include "entropy.h"

#include <algorithm>
#include <cstdlib>
#include <cstring>

namespace splash {
namespace {

// Of a probability, and by which share of what is left an answer moves it.
constexpr int ONE_BITS = 12, MOVES = 5;
constexpr uint16_t EVEN = 1 << (ONE_BITS - 1);
// The range is kept above this.
constexpr uint32_t LEAST_RANGE = 1u << 24;
// Digits of a number, at the most.
constexpr int LONGEST = 31;
// Questions about a number in one context: is it zero, its sign, its exponent, and the digit after its first.
constexpr int QUESTIONS = 2 + 2 * (LONGEST + 1);
// Kinds of nearby numbers, by how large they are.
constexpr int SIZES = 10;
// Along each axis of a signed distance's blocks.
constexpr int BLOCK = 4;
constexpr int NODE_CONTEXTS = 7 * 3 * 3 * 3, BLOCK_CONTEXTS = 16;
// What of a table counts as context.
constexpr int BY_ROWS = 1, BY_ROWS_AND_COLUMNS = 2;

struct Writer {
    static constexpr bool READS = false;
    SplashCode& code;

    void shift() {
        if (code.low < 0xFF000000u || code.low > 0xFFFFFFFFu) {
            const uint8_t carry = static_cast<uint8_t>(code.low >> 32);
            uint8_t byte = code.first;
            for (; code.waiting > 0; --code.waiting) {
                code.out.push_back(static_cast<uint8_t>(byte + carry));
                byte = 0xFF;
            }
            code.first = static_cast<uint8_t>(code.low >> 24);
        }
        ++code.waiting;
        code.low = (code.low & 0x00FFFFFFu) << 8;
    }

    void refill() {
        for (; code.range < LEAST_RANGE; code.range <<= 8) shift();
    }

    int ask(uint16_t& zero, int answer) {
        const uint32_t bound = (code.range >> ONE_BITS) * zero;
        if (answer == 0) {
            code.range = bound;
            zero += ((1 << ONE_BITS) - zero) >> MOVES;
        } else {
            code.low += bound;
            code.range -= bound;
            zero -= zero >> MOVES;
        }
        refill();
        return answer;
    }

    int ask_evenly(int answer) {
        code.range >>= 1;
        if (answer != 0) code.low += code.range;
        refill();
        return answer;
    }

    bool sound() const { return true; }
};

struct Reader {
    static constexpr bool READS = true;
    SplashCode& code;

    void refill() {
        for (; code.range < LEAST_RANGE; code.range <<= 8) {
            code.word = (code.word << 8) | (code.at < code.size ? code.code[code.at] : 0);
            ++code.at;
        }
    }

    int ask(uint16_t& zero, int) {
        const uint32_t bound = (code.range >> ONE_BITS) * zero;
        const int answer = code.word < bound ? 0 : 1;
        if (answer == 0) {
            code.range = bound;
            zero += ((1 << ONE_BITS) - zero) >> MOVES;
        } else {
            code.word -= bound;
            code.range -= bound;
            zero -= zero >> MOVES;
        }
        refill();
        return answer;
    }

    int ask_evenly(int) {
        code.range >>= 1;
        const int answer = code.word >= code.range ? 1 : 0;
        if (answer != 0) code.word -= code.range;
        refill();
        return answer;
    }

    bool sound() const { return !code.overrun(); }
};

// Is it other than zero? Is it below? How many digits has it in binary, one by one? Its second digit; and the others, which
// are even. A writer's `number` is below 2^31 in size; a reader's is what is found, of up to 32 digits.
template <class Coder>
int64_t code_number(Coder& coder, uint16_t* zeros, int64_t number) {
    if (coder.ask(zeros[0], number != 0) == 0) return 0;
    const int below = coder.ask(zeros[1], number < 0);
    const int64_t size = std::abs(number);
    int exponent = 0;
    while (exponent < LONGEST && coder.ask(zeros[2 + exponent], (size >> (exponent + 1)) > 0) != 0) ++exponent;
    int64_t found = 1;
    for (int digit = exponent - 1; digit >= 0; --digit) {
        const int one = static_cast<int>((size >> digit) & 1);
        found = 2 * found + (digit == exponent - 1 ? coder.ask(zeros[3 + LONGEST + exponent], one) : coder.ask_evenly(one));
    }
    return below != 0 ? -found : found;
}

// 0 for 0, then by powers of two, below SIZES.
int size_of(int64_t total) {
    int size = 0;
    for (; total > 0 && size < SIZES - 1; total >>= 1) ++size;
    return size;
}

std::vector<uint16_t> probabilities(int64_t contexts) { return std::vector<uint16_t>(contexts * QUESTIONS, EVEN); }

int64_t absolute(int64_t number) { return number < 0 ? -number : number; }

template <class Coder>
bool table_by(Coder coder, int32_t* table, int64_t rows, int32_t columns, int32_t near) {
    const int64_t befores = near >= BY_ROWS ? SIZES : 1, besides = near >= BY_ROWS_AND_COLUMNS ? SIZES : 1;
    std::vector<uint16_t> zeros = probabilities(columns * befores * besides);
    for (int64_t row = 0; row < rows; ++row) {
        for (int32_t column = 0; column < columns; ++column) {
            int32_t* const at = table + row * columns + column;
            int64_t before = 0, beside = 0;
            if (near >= BY_ROWS && row > 0) before += 2 * absolute(at[-columns]);
            if (near >= BY_ROWS && row > 1) before += absolute(at[-2 * static_cast<int64_t>(columns)]);
            if (near >= BY_ROWS_AND_COLUMNS && column > 0) beside += 2 * absolute(at[-1]);
            if (near >= BY_ROWS_AND_COLUMNS && column > 1) beside += absolute(at[-2]);
            const int64_t context = (column * befores + size_of(before)) * besides + size_of(beside);
            const int64_t found = code_number(coder, zeros.data() + context * QUESTIONS, *at);
            if (!coder.sound() || found < -INT32_MAX || found > INT32_MAX) return false;
            if constexpr (Coder::READS) *at = static_cast<int32_t>(found);
        }
    }
    return true;
}

template <class Coder>
bool field_by(Coder coder, int16_t* field, const int64_t shape[5]) {
    const int64_t components = shape[4], by_z = components, by_y = shape[3] * by_z, by_x = shape[2] * by_y;
    const int64_t by_t = shape[1] * by_x;
    std::vector<uint16_t> zeros = probabilities(components * SIZES * SIZES);
    int16_t* at = field;
    for (int64_t t = 0; t < shape[0]; ++t)
        for (int64_t x = 0; x < shape[1]; ++x)
            for (int64_t y = 0; y < shape[2]; ++y)
                for (int64_t z = 0; z < shape[3]; ++z)
                    for (int64_t component = 0; component < components; ++component, ++at) {
                        const int64_t b_or_none = y > 0 ? at[-by_y] : 0;
                        const int64_t a = x > 0 ? at[-by_x] : b_or_none, b = y > 0 ? at[-by_y] : a;
                        const int64_t c = z > 0 ? at[-by_z] : b;
                        // Where nothing moves nearby nothing is likely to; else what moved is.
                        const bool resting = (a == 0) + (b == 0) + (c == 0) >= 2;
                        const int64_t likely = !resting && t > 0 ? at[-by_t] : 0;
                        int kind = component == 0 ? 0 : std::min(1 + size_of(absolute(at[-1])), SIZES - 2);
                        if (resting) kind = component > 0 && at[-1] == 0 ? SIZES - 1 : SIZES - 2;
                        const int differ = size_of((absolute(a - b) + absolute(b - c) + absolute(a - c)) >> 2);
                        const int64_t context = (component * SIZES + differ) * SIZES + kind;
                        const int64_t found = code_number(coder, zeros.data() + context * QUESTIONS, *at - likely) + likely;
                        if (!coder.sound() || found < INT16_MIN || found > INT16_MAX) return false;
                        if constexpr (Coder::READS) *at = static_cast<int16_t>(found);
                    }
    return true;
}

int at_end(int value, int least, int most) { return value <= least ? 2 : (value >= most ? 1 : 0); }

// A frame of signed distances, and what is known of it and of the one before.
struct Frame {
    int8_t* now;
    const int8_t* before;
    int64_t nx, ny, nz;
    int least, most;

    int gained(int64_t node) const { return now[node] - before[node]; }

    // Nodes of a block begin here and end there.
    template <class Each>
    bool each(int64_t i, int64_t j, int64_t k, Each visit) const {
        for (int64_t x = BLOCK * i; x < std::min(BLOCK * (i + 1), nx); ++x)
            for (int64_t y = BLOCK * j; y < std::min(BLOCK * (j + 1), ny); ++y)
                for (int64_t z = BLOCK * k; z < std::min(BLOCK * (k + 1), nz); ++z)
                    if (!visit(x, y, z, (x * ny + y) * nz + z)) return false;
        return true;
    }
};

// A node is likely to have what it had, and as much more as its three neighbours gained on average.
template <class Coder>
bool node_by(Coder& coder, const Frame& frame, uint16_t* zeros, int64_t x, int64_t y, int64_t z, int64_t node) {
    const int had = frame.before[node];
    const int a = x > 0 ? frame.gained(node - frame.ny * frame.nz) : 0;
    const int b = y > 0 ? frame.gained(node - frame.nz) : 0;
    const int c = z > 0 ? frame.gained(node - 1) : 0;
    const int gained = a + b + c, rounded = 2 * gained + 3;
    const int third = rounded >= 0 ? rounded / 6 : -((5 - rounded) / 6);  // rounded down
    const int likely = std::clamp(had + third, frame.least, frame.most);
    const int differ = std::abs(a - b) + std::abs(b - c) + std::abs(a - c);
    int kind = 0;
    for (const int bound : {0, 2, 4, 8, 14, 24}) kind += differ > bound;
    const int much = gained == 0 ? 0 : (std::abs(gained) < 4 ? 1 : 2);
    const int ends = at_end(likely, frame.least, frame.most) * 3 + at_end(had, frame.least, frame.most);
    const int context = (kind * 9 + ends) * 3 + much;
    const int64_t found = code_number(coder, zeros + context * QUESTIONS, frame.now[node] - likely) + likely;
    if (!coder.sound() || found < frame.least || found > frame.most) return false;
    if constexpr (Coder::READS) frame.now[node] = static_cast<int8_t>(found);
    return true;
}

template <class Coder>
bool frame_by(Coder coder, const Frame& frame, uint8_t* changed) {
    const int64_t ni = (frame.nx + BLOCK - 1) / BLOCK, nj = (frame.ny + BLOCK - 1) / BLOCK, nk = (frame.nz + BLOCK - 1) / BLOCK;
    std::vector<uint8_t> changes(ni * nj * nk);
    for (int64_t i = 0; i < ni; ++i)
        for (int64_t j = 0; j < nj; ++j)
            for (int64_t k = 0; k < nk; ++k) {
                const int64_t block = (i * nj + j) * nk + k;
                const int nearby = (i > 0 ? 2 * changes[block - nj * nk] : 0) + (j > 0 ? 4 * changes[block - nk] : 0) +
                                   (k > 0 ? 8 * changes[block - 1] : 0);
                const bool alike = frame.each(i, j, k, [&](int64_t, int64_t, int64_t, int64_t node) {
                    return frame.now[node] == frame.before[node];
                });
                changes[block] = static_cast<uint8_t>(coder.ask(coder.code.blocks[changed[block] + nearby], alike ? 0 : 1));
                if (!coder.sound()) return false;
                if (changes[block] == 0) continue;
                const bool found = frame.each(i, j, k, [&](int64_t x, int64_t y, int64_t z, int64_t node) {
                    return node_by(coder, frame, coder.code.nodes.data(), x, y, z, node);
                });
                if (!found) return false;
            }
    std::memcpy(changed, changes.data(), changes.size());
    return true;
}

}  // namespace

bool code_table(SplashCode& code, int32_t* table, int64_t rows, int32_t columns, int32_t near) {
    return code.writes ? table_by(Writer{code}, table, rows, columns, near) : table_by(Reader{code}, table, rows, columns, near);
}

bool code_field(SplashCode& code, int16_t* field, const int64_t shape[5]) {
    return code.writes ? field_by(Writer{code}, field, shape) : field_by(Reader{code}, field, shape);
}

bool code_frame(SplashCode& code, int8_t* now, const int8_t* before, uint8_t* changed, const int64_t shape[3], int32_t least,
                int32_t most) {
    if (code.nodes.empty()) {
        code.nodes = probabilities(NODE_CONTEXTS);
        code.blocks.assign(BLOCK_CONTEXTS, EVEN);
    }
    const Frame frame{now, before, shape[0], shape[1], shape[2], least, most};
    return code.writes ? frame_by(Writer{code}, frame, changed) : frame_by(Reader{code}, frame, changed);
}

int64_t code_finished(SplashCode& code) {
    if (!code.writes) return 0;
    for (int byte = 0; byte < 5; ++byte) Writer{code}.shift();
    return static_cast<int64_t>(code.out.size());
}

}  // namespace splash

SplashCode::SplashCode(const uint8_t* given, int64_t length) : writes(given == nullptr), code(given), size(length) {
    if (writes) return;
    for (; at < 5; ++at) word = (word << 8) | (at < size ? code[at] : 0);
}
