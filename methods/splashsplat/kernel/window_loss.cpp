// Losses of a rendered window, and their gradients, row by row.
//
// A row of the box is spread out to floats, channel by channel as in the image: the error; 1 in the mask, else 0; and the
// same of the pair with the next pixel. Rows end in zeros up to whole vectors, and the pair beyond the last pixel counts 0.

#include "window_loss.h"

#include <algorithm>
#include <cmath>

#include "native/buffer.h"
#include "native/elementary.h"
#include "native/threads.h"

namespace splash {
namespace {

constexpr int CHANNELS = 3;
constexpr double EPSILON = 1e-6;
// Sums are taken over so many rows, then in the order of these.
constexpr int ROWS_PER_PIECE = 16;

Floats sign(Floats x) { return where(x > 0.0f, all(1.0f)) - where(x < 0.0f, all(1.0f)); }

struct Row {
    Buffer<float> error, mask, pair;
};

// Sums over the box: |error| in the mask, |error's step| over pairs; and how many values these are.
struct Sums {
    double error, step, values, pairs;
};

class Box {
  public:
    Box(const SplashWindow& window, const float* image)
        : window_(window), image_(image), used_(CHANNELS * window.columns), length_((used_ + LANES - 1) / LANES * LANES) {}

    // Row y of the box, or zeros where it has none.
    void read(int y, Row& row) const {
        const size_t roomy = length_ + LANES + CHANNELS;
        float* const error = row.error.fit(roomy);
        float* const mask = row.mask.fit(roomy);
        float* const pair = row.pair.fit(length_);
        const int used = has(y) ? used_ : 0;
        if (used > 0) {
            const float* const shown = image_ + (static_cast<int64_t>(window_.top + y) * window_.width + window_.left) * CHANNELS;
            const uint8_t* const truth = window_.truth + static_cast<int64_t>(y) * used_;
            const uint8_t* const liquid = window_.mask + static_cast<int64_t>(y) * window_.columns;
            for (int i = 0; i < used; ++i) error[i] = shown[i] - static_cast<float>(truth[i]) / 255.0f;
            for (int x = 0; x < window_.columns; ++x) {
                const float in_mask = liquid[x] != 0 ? 1.0f : 0.0f;
                for (int channel = 0; channel < CHANNELS; ++channel) mask[CHANNELS * x + channel] = in_mask;
            }
        }
        std::fill(error + used, error + roomy, 0.0f);
        std::fill(mask + used, mask + roomy, 0.0f);
        for (int i = 0; i < length_; ++i) pair[i] = std::max(mask[i], mask[i + CHANNELS]);
        std::fill(pair + std::max(0, used - CHANNELS), pair + length_, 0.0f);
    }

    Sums sums(int begin, int end) const {
        static thread_local Row rows[2];
        Sums total{};
        read(begin, rows[0]);
        for (int y = begin; y < end; ++y) {
            const Row& here = rows[(y - begin) % 2];
            Row& below = rows[(y - begin + 1) % 2];
            read(y + 1, below);
            Floats error{}, step{}, values{}, pairs{};
            for (int i = 0; i < length_; i += LANES) {
                const Floats at = load(&here.error[i]), mask = load(&here.mask[i]), across = load(&here.pair[i]);
                const Floats down = has(y + 1) ? max(mask, load(&below.mask[i])) : Floats{};
                error += absolute(at) * mask;
                step += absolute(load_anywhere(&here.error[i + CHANNELS]) - at) * across;
                step += absolute(load(&below.error[i]) - at) * down;
                values += mask;
                pairs += across + down;
            }
            total.error += sum(error);
            total.step += sum(step);
            total.values += sum(values);
            total.pairs += sum(pairs);
        }
        return total;
    }

    // Gradients by the rows of the box, given those by |error| and by |step|, into the window's [height, width, 3].
    void gradients(int begin, int end, float by_error, float by_step, float* grad) const {
        static thread_local Row rows[3];
        static thread_local Buffer<float> steps, result;
        // The steps across stand one vector late, so that the first pixel finds a zero before it.
        float* const across = steps.fit(length_ + LANES) + LANES;
        float* const out = result.fit(length_);
        std::fill(across - LANES, across, 0.0f);
        read(begin - 1, rows[0]);
        read(begin, rows[1]);
        for (int y = begin; y < end; ++y) {
            const Row& above = rows[(y - begin) % 3];
            const Row& here = rows[(y - begin + 1) % 3];
            Row& below = rows[(y - begin + 2) % 3];
            read(y + 1, below);
            for (int i = 0; i < length_; i += LANES) {
                store(across + i, sign(load_anywhere(&here.error[i + CHANNELS]) - load(&here.error[i])) * load(&here.pair[i]));
            }
            for (int i = 0; i < length_; i += LANES) {
                const Floats at = load(&here.error[i]), mask = load(&here.mask[i]);
                Floats step = load_anywhere(across + i - CHANNELS) - load(across + i);
                if (has(y - 1)) step += sign(at - load(&above.error[i])) * max(mask, load(&above.mask[i]));
                if (has(y + 1)) step -= sign(load(&below.error[i]) - at) * max(mask, load(&below.mask[i]));
                store(out + i, by_error * sign(at) * mask + by_step * step);
            }
            std::copy(out, out + used_, grad + (static_cast<int64_t>(window_.top + y) * window_.width + window_.left) * CHANNELS);
        }
    }

  private:
    bool has(int y) const { return y >= 0 && y < window_.rows; }

    const SplashWindow& window_;
    const float* image_;
    int used_, length_;
};

// A row of the whole window's mask, as floats.
void read_mask(const SplashWindow& w, int y, float* mask) {
    std::fill(mask, mask + w.width, 0.0f);
    if (y < w.top || y >= w.top + w.rows) return;
    const uint8_t* const liquid = w.mask + static_cast<int64_t>(y - w.top) * w.columns;
    for (int x = 0; x < w.columns; ++x) mask[w.left + x] = liquid[x] != 0 ? 1.0f : 0.0f;
}

// Calls work(begin, end, piece) for pieces of `rows` rows.
template <class Work>
int64_t by_rows(int threads, int rows, Work&& work) {
    const int64_t pieces = (rows + ROWS_PER_PIECE - 1) / ROWS_PER_PIECE;
    in_pieces(threads, pieces, 1, [&](int64_t piece, int64_t, int) {
        const int begin = static_cast<int>(piece) * ROWS_PER_PIECE;
        work(begin, std::min(rows, begin + ROWS_PER_PIECE), piece);
    });
    return pieces;
}

Sums sums_of(const SplashWindow& w, const float* image, int threads) {
    const Box box(w, image);
    Buffer<Sums> parts;
    parts.fit(w.rows / ROWS_PER_PIECE + 1);
    const int64_t pieces =
        by_rows(threads, w.rows, [&](int begin, int end, int64_t piece) { parts[piece] = box.sums(begin, end); });
    Sums total{};
    for (int64_t piece = 0; piece < pieces; ++piece) {
        total.error += parts[piece].error;
        total.step += parts[piece].step;
        total.values += parts[piece].values;
        total.pairs += parts[piece].pairs;
    }
    return total;
}

}  // namespace

void window_losses(const SplashWindow& w, const float* image, const float* alpha, double losses[3], int threads) {
    const Sums total = sums_of(w, image, threads);
    losses[0] = total.error / (total.values + EPSILON);
    losses[1] = total.step / (total.pairs + EPSILON);
    Buffer<double> parts;
    parts.fit(w.height / ROWS_PER_PIECE + 1);
    const int64_t pieces = by_rows(threads, w.height, [&](int begin, int end, int64_t piece) {
        static thread_local Buffer<float> mask_row;
        float* const mask = mask_row.fit(w.width);
        parts[piece] = 0.0;
        for (int y = begin; y < end; ++y) {
            read_mask(w, y, mask);
            const float* const row = alpha + static_cast<int64_t>(y) * w.width;
            for (int x = 0; x < w.width; ++x) parts[piece] += std::fabs(row[x] - mask[x]);
        }
    });
    losses[2] = 0.0;
    for (int64_t piece = 0; piece < pieces; ++piece) losses[2] += parts[piece];
}

void window_gradients(const SplashWindow& w, const float* image, const float* alpha, const double weights[3], float* grad_image,
                      float* grad_alpha, int threads) {
    const Sums total = sums_of(w, image, threads);
    const Box box(w, image);
    const float by_error = static_cast<float>(weights[0] / (total.values + EPSILON));
    const float by_step = static_cast<float>(weights[1] / (total.pairs + EPSILON));
    const float by_alpha = static_cast<float>(weights[2]);
    by_rows(threads, w.height, [&](int begin, int end, int64_t) {
        static thread_local Buffer<float> mask_row;
        float* const mask = mask_row.fit(w.width);
        for (int y = begin; y < end; ++y) {
            read_mask(w, y, mask);
            const float* const row = alpha + static_cast<int64_t>(y) * w.width;
            float* const out = grad_alpha + static_cast<int64_t>(y) * w.width;
            for (int x = 0; x < w.width; ++x) out[x] = row[x] > mask[x] ? by_alpha : row[x] < mask[x] ? -by_alpha : 0.0f;
            std::fill(grad_image + static_cast<int64_t>(y) * w.width * CHANNELS,
                      grad_image + static_cast<int64_t>(y + 1) * w.width * CHANNELS, 0.0f);
        }
    });
    by_rows(threads, w.rows, [&](int begin, int end, int64_t) { box.gradients(begin, end, by_error, by_step, grad_image); });
}

}  // namespace splash
