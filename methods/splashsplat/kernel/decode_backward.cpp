// Carriers to Gaussians, the backward pass, on what the forward pass kept.

#include <algorithm>
#include <cmath>

#include "decode.h"
#include "native/multiply.h"
#include "native/elementary.h"
#include "native/threads.h"

namespace splash {
namespace {

struct Scratch {
    Buffer<float> inputs;     // [BLOCK, first_step], a carrier's inputs in a row
    Buffer<float> children;   // gradients by the children, in rows of BLOCK
    Buffer<float> outputs;    // and by the heads' answers
    Buffer<float> color;      // [BLOCK, in_vectors(3K)], by the colour head's answers, a carrier's in a row
    Buffer<float> features;   // [BLOCK, in_vectors(F)]
    Buffer<float> log_scales; // [3, BLOCK]
};

// Where the gradients by the children stand in Scratch::children.
struct ChildRows {
    explicit ChildRows(int k) : means(0), factors(3 * k), opacities(12 * k), offsets(13 * k), colors(16 * k), total(19 * k) {}

    int means, factors, opacities, offsets, colors, total;
};

// What one unit of each penalty weighs for one carrier (the first two), one colour (the last).
struct PenaltyWeights {
    PenaltyWeights(const SplashCarriers& c, int k, const double grad[3]) {
        const double carriers = static_cast<double>(std::max<int64_t>(c.count, 1));
        trace = static_cast<float>(grad[0] / (carriers * k));
        hinge = static_cast<float>(grad[1] / (carriers * std::max(k * (k - 1) / 2, 1)));
        color = static_cast<float>(grad[2] / (carriers * 3 * k));
    }

    float trace, hinge, color;
};

void gather_inputs(const Weights& w, const SplashCarriers& c, Part part, const float* direction, float* inputs) {
    const int size = w.heads.features;
    std::fill(inputs, inputs + BLOCK * w.first_step, 0.0f);
    for (int i = 0; i < part.count; ++i) {
        const int64_t row = row_of(c, part.begin + i);
        float* const input = inputs + i * w.first_step;
        prefetch_features(c, size, part.begin + i);
        std::copy(c.features + row * size, c.features + (row + 1) * size, input);
        for (int axis = 0; axis < 3; ++axis) input[size + axis] = direction[axis * BLOCK + i];
        input[size + 3] = 1.0f;
    }
}

void gather_children(const SplashChildren& grad, int k, Part part, float* children) {
    const ChildRows to(k);
    const auto gather = [&](const float* source, int width, int row) {
        to_lanes(source == nullptr ? nullptr : source + width * part.begin, width, part.count, children + row * BLOCK);
    };
    gather(grad.means, 3 * k, to.means);
    gather(grad.factors, 9 * k, to.factors);
    gather(grad.opacities, k, to.opacities);
    gather(grad.offsets, 3 * k, to.offsets);
    gather(grad.colors, 3 * k, to.colors);
}

// Pushes the children of one carrier apart: adds to the gradients by their offsets.
void separate(const Weights& w, const Rows& at, const float* block, float weight, float* offsets) {
    const Floats margin = all(w.heads.separation_margin);
    for (int i = 0; i < BLOCK; i += LANES) {
        for (int a = 0; a < at.k; ++a) {
            for (int b = a + 1; b < at.k; ++b) {
                Floats apart[3], squares{};
                for (int axis = 0; axis < 3; ++axis) {
                    apart[axis] = load(block + (at.offset + 3 * a + axis) * BLOCK + i) -
                                  load(block + (at.offset + 3 * b + axis) * BLOCK + i);
                    apart[axis] *= w.heads.offset_bound;
                    squares += apart[axis] * apart[axis];
                }
                const Floats distance = square_root(max(all(1e-12f), squares));
                // A pair that coincides is pushed along no direction at all.
                const Ints pushed = (distance < margin) & (squares >= 1e-12f);
                const Floats push = where(pushed, -2.0f * weight * (margin - distance) / distance);
                for (int axis = 0; axis < 3; ++axis) {
                    float* const first = offsets + (3 * a + axis) * BLOCK + i;
                    float* const second = offsets + (3 * b + axis) * BLOCK + i;
                    store(first, load(first) + push * apart[axis]);
                    store(second, load(second) - push * apart[axis]);
                }
            }
        }
    }
}

// Draws the colours of a cell together: adds to the gradients by them. Through the cell's mean there is none, because
// distances from a mean add up to zero.
void unify(const SplashCarriers& c, const Rows& at, const float* block, const float* cell_colors, Part part, float weight,
           float* colors) {
    for (int i = 0; i < part.count; ++i) {
        const float* const cell = cell_colors + 3 * c.cells[part.begin + i];
        for (int j = 0; j < 3 * at.k; ++j) {
            colors[j * BLOCK + i] += 2.0f * weight * (block[(at.color + j) * BLOCK + i] - cell[j % 3]);
        }
    }
}

// From the gradients by the children to those by the heads' answers (but for the hidden layer) and by the log scales.
void shape_gradients(const Weights& w, const Rows& at, const float* block, float trace_weight, const float* children,
                     float* outputs, float* log_scales) {
    const int k = at.k;
    const ChildRows from(k);
    for (int i = 0; i < BLOCK; i += LANES) {
        const auto row = [&](int index) { return load(block + index * BLOCK + i); };
        const auto grad = [&](int index) { return load(children + index * BLOCK + i); };
        const auto put = [&](int index, Floats value) { store(outputs + index * BLOCK + i, value); };
        Floats F[9], squares[3], by_log_scale[3];
        for (int j = 0; j < 9; ++j) F[j] = row(at.deformation + j);
        for (int axis = 0; axis < 3; ++axis) {
            squares[axis] = F[axis] * F[axis] + F[3 + axis] * F[3 + axis] + F[6 + axis] * F[6 + axis];
            by_log_scale[axis] = Floats{};
        }
        const Floats fade = row(at.fade);
        for (int child = 0; child < k; ++child) {
            for (int axis = 0; axis < 3; ++axis) {
                const int j = 3 * child + axis;
                Floats by_local{}, by_extent{};
                for (int r = 0; r < 3; ++r) {
                    by_local += F[3 * r + axis] * grad(from.means + 3 * child + r);
                    by_extent += F[3 * r + axis] * grad(from.factors + 9 * child + 3 * r + axis);
                }
                const Floats base = row(at.base + axis), bounded = row(at.offset + j), residual = row(at.scale + j);
                const Floats extent = row(at.extent + j);
                by_extent += 2.0f * trace_weight * extent * squares[axis];
                const Floats by_log_extent = by_extent * extent;
                const Floats by_offset = base * by_local + grad(from.offsets + j);
                by_log_scale[axis] += base * w.heads.offset_bound * bounded * by_local + by_log_extent;
                put(at.offset + j, by_offset * w.heads.offset_bound * (1.0f - bounded * bounded));
                put(at.scale + j, by_log_extent * w.heads.scale_range * (1.0f - residual * residual));
            }
            const Floats learned = row(at.opacity + child);
            put(at.opacity + child, grad(from.opacities + child) * fade * learned * (1.0f - learned));
        }
        for (int axis = 0; axis < 3; ++axis) store(log_scales + axis * BLOCK + i, by_log_scale[axis]);
    }
}

// From the gradients by the colours, in rows, to those by the colour head's answers.
void color_gradients(const Rows& at, const float* block, float* colors) {
    for (int i = 0; i < 3 * at.k * BLOCK; i += LANES) {
        const Floats color = load(block + at.color * BLOCK + i);
        store(colors + i, load(colors + i) * color * (1.0f - color));
    }
}

// Sums of gradients by the weights, over one piece: those of the first matrix, then those of the second one's transpose.
struct WeightSums {
    WeightSums(const Weights& w)
        : second_step(in_vectors(3 * w.heads.children)),
          second(static_cast<int64_t>(w.outputs) * w.first_step),
          total(second + static_cast<int64_t>(w.heads.hidden + 1) * second_step) {}

    int second_step;
    int64_t second, total;
};

void backward_block(const Weights& w, const Rows& at, const SplashCarriers& c, Part part, const float* block,
                    const float* cell_colors, const SplashChildren& grad, const PenaltyWeights& penalties,
                    const SplashDecoderGradients& out, const WeightSums& layout, float* sums, Scratch& scratch) {
    const int k = at.k, size = w.heads.features, hidden = w.heads.hidden;
    const ChildRows rows(k);
    float* const inputs = scratch.inputs.data();
    float* const children = scratch.children.data();
    float* const outputs = scratch.outputs.data();
    float* const by_color = scratch.color.data();
    float* const by_feature = scratch.features.data();
    float* const by_log_scale = scratch.log_scales.data();
    float* const colors = children + rows.colors * BLOCK;
    const int feature_step = in_vectors(size);

    gather_inputs(w, c, part, block + at.direction * BLOCK, inputs);
    gather_children(grad, k, part, children);
    if (penalties.hinge != 0.0f) separate(w, at, block, penalties.hinge, children + rows.offsets * BLOCK);
    if (penalties.color != 0.0f) unify(c, at, block, cell_colors, part, penalties.color, colors);
    shape_gradients(w, at, block, penalties.trace, children, outputs, by_log_scale);
    color_gradients(at, block, colors);
    from_lanes(colors, 3 * k, BLOCK, by_color, layout.second_step);

    float* const by_hidden = outputs + at.hidden * BLOCK;
    multiply({w.second.data(), 1, w.second_step}, colors, BLOCK, by_hidden, BLOCK, hidden, 3 * k, BLOCK);
    for (int i = 0; i < hidden * BLOCK; i += LANES) {
        store(by_hidden + i, where(load(block + at.hidden * BLOCK + i) > 0.0f, load(by_hidden + i)));
    }
    multiply({outputs, BLOCK, 1}, inputs, w.first_step, sums, w.first_step, w.outputs, BLOCK, w.first_step, true);
    multiply({block + at.hidden * BLOCK, BLOCK, 1}, by_color, layout.second_step, sums + layout.second, layout.second_step,
             hidden + 1, BLOCK, layout.second_step, true);
    multiply({outputs, 1, BLOCK}, w.first.data(), w.first_step, by_feature, feature_step, part.count, w.outputs, feature_step);
    for (int i = 0; i < part.count; ++i) {
        std::copy(by_feature + i * feature_step, by_feature + i * feature_step + size, out.features + (part.begin + i) * size);
    }
    from_lanes(by_log_scale, 3, part.count, out.log_scales + 3 * part.begin, 3);
}

// Adds the pieces' sums in their order, and takes the matrices apart into the heads' gradients.
void unpack(const Weights& w, const WeightSums& layout, float* sums, int64_t pieces, const SplashDecoderGradients& out) {
    for (int64_t piece = 1; piece < pieces; ++piece) {
        const float* const more = sums + piece * layout.total;
        for (int64_t i = 0; i < layout.total; ++i) sums[i] += more[i];
    }
    const int size = w.heads.features, k = w.heads.children, hidden = w.heads.hidden;
    const float* row = sums;
    const auto take = [&](float* weight, float* bias, int count, int width) {
        for (int i = 0; i < count; ++i, row += w.first_step) {
            std::copy(row, row + width, weight + i * width);
            bias[i] = row[size + 3];
        }
    };
    take(out.offset_weight, out.offset_bias, 3 * k, size);
    take(out.scale_weight, out.scale_bias, 3 * k, size);
    take(out.opacity_weight, out.opacity_bias, k, size);
    take(out.hidden_weight, out.hidden_bias, hidden, size + 3);
    const float* const second = sums + layout.second;
    for (int i = 0; i < 3 * k; ++i) {
        for (int j = 0; j < hidden; ++j) out.color_weight[i * hidden + j] = second[j * layout.second_step + i];
        out.color_bias[i] = second[hidden * layout.second_step + i];
    }
}

}  // namespace

void decode_backward(const Weights& w, const SplashCarriers& c, const float* kept, const float* cell_colors,
                     const SplashChildren& grad, const double grad_penalties[3], int threads,
                     const SplashDecoderGradients& out) {
    const Rows at(w.heads);
    const WeightSums layout(w);
    const PenaltyWeights penalties(c, at.k, grad_penalties);
    const int64_t pieces = pieces_of(c.count), blocks = blocks_of(c.count);
    static thread_local Buffer<float> buffer;
    float* const sums = buffer.fit(std::max<int64_t>(pieces, 1) * layout.total);
    if (pieces == 0) std::fill(sums, sums + layout.total, 0.0f);
    in_pieces(threads, pieces, 1, [&](int64_t piece, int64_t, int) {
        static thread_local Scratch scratch;
        scratch.inputs.fit(BLOCK * w.first_step);
        scratch.children.fit(ChildRows(at.k).total * BLOCK);
        scratch.outputs.fit(w.outputs * BLOCK);
        scratch.color.fit(BLOCK * layout.second_step);
        scratch.features.fit(BLOCK * in_vectors(w.heads.features));
        scratch.log_scales.fit(3 * BLOCK);
        // Columns of padding are read by the products and never written.
        std::fill(scratch.color.data(), scratch.color.data() + BLOCK * layout.second_step, 0.0f);
        float* const piece_sums = sums + piece * layout.total;
        std::fill(piece_sums, piece_sums + layout.total, 0.0f);
        for (int64_t block = piece * BLOCKS_PER_PIECE; block < std::min(blocks, (piece + 1) * BLOCKS_PER_PIECE); ++block) {
            backward_block(w, at, c, part_of(c.count, block), kept + block * at.total * BLOCK, cell_colors, grad, penalties,
                           out, layout, piece_sums, scratch);
        }
    });
    unpack(w, layout, sums, pieces, out);
}

}  // namespace splash
