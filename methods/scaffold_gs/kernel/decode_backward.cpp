// Static anchors to Gaussians, the backward pass, on what the forward pass kept.

#include <algorithm>

#include "anchors.h"
#include "native/elementary.h"
#include "native/multiply.h"
#include "native/threads.h"

namespace splash {
namespace {

struct Scratch {
    Buffer<float> inputs;     // [BLOCK, first_step], an anchor's inputs in a row
    Buffer<float> children;   // gradients by the children, in rows of BLOCK
    Buffer<float> answers;    // and by the heads' answers, as they were before tanh and sigmoids
    Buffer<float> turned;     // [BLOCK, in_vectors(7K)], by one head's answers, an anchor's in a row
    Buffer<float> hidden;     // by the hidden layers, in rows of BLOCK
    Buffer<float> features;   // [BLOCK, in_vectors(F)]
    Buffer<float> tables;     // by log scales and offsets, in rows of BLOCK
};

// Where the gradients by the children stand in Scratch::children.
struct ChildRows {
    explicit ChildRows(int k) : means(0), factors(3 * k), opacities(12 * k), scales(13 * k), colors(16 * k), total(19 * k) {}

    int means, factors, opacities, scales, colors, total;
};

// Sums of gradients by the weights, over one piece: by the first matrix; then by each head's second one, transposed, and by
// its biases.
struct WeightSums {
    explicit WeightSums(const Weights& w, const Rows& at) : total(static_cast<int64_t>(HEADS) * w.heads.hidden * w.first_step) {
        for (int number = 0; number < HEADS; ++number) {
            step[number] = in_vectors(at.outputs(number));
            second[number] = total;
            bias[number] = total + static_cast<int64_t>(w.heads.hidden) * step[number];
            total = bias[number] + step[number];
        }
    }

    int step[HEADS];
    int64_t second[HEADS], bias[HEADS], total;
};

void gather_inputs(const Weights& w, const SplashAnchors& a, Part part, const float* direction, float* inputs) {
    const int size = w.heads.features;
    std::fill(inputs, inputs + BLOCK * w.first_step, 0.0f);
    for (int i = 0; i < part.count; ++i) {
        const float* const feature = a.features + row_of(a, part.begin + i) * size;
        float* const input = inputs + i * w.first_step;
        std::copy(feature, feature + size, input);
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
    gather(grad.scales, 3 * k, to.scales);
    gather(grad.colors, 3 * k, to.colors);
}

// Gradients by a quaternion as answered, q = length u, from those by the rotation by u.
void turn_back(const Floats u[4], Floats unit, const Floats by[9], Floats by_q[4]) {
    const Floats &w = u[0], &x = u[1], &y = u[2], &z = u[3];
    const Floats grad[4] = {
        2.0f * (x * (by[7] - by[5]) + y * (by[2] - by[6]) + z * (by[3] - by[1])),
        2.0f * (w * (by[7] - by[5]) + y * (by[1] + by[3]) + z * (by[2] + by[6]) - 2.0f * x * (by[4] + by[8])),
        2.0f * (w * (by[2] - by[6]) + x * (by[1] + by[3]) + z * (by[5] + by[7]) - 2.0f * y * (by[0] + by[8])),
        2.0f * (w * (by[3] - by[1]) + x * (by[2] + by[6]) + y * (by[5] + by[7]) - 2.0f * z * (by[0] + by[4])),
    };
    const Floats along = grad[0] * u[0] + grad[1] * u[1] + grad[2] * u[2] + grad[3] * u[3];
    for (int j = 0; j < 4; ++j) by_q[j] = (grad[j] - u[j] * along) * unit;
}

// From the gradients by the children to those by the heads' answers, by the log scales and by the offsets.
void shape_gradients(const Rows& at, const float* block, const float* children, float* answers, float* by_log_scale,
                     float* by_offset) {
    const int k = at.k;
    const ChildRows from(k);
    for (int i = 0; i < BLOCK; i += LANES) {
        const auto row = [&](int index) { return load(block + index * BLOCK + i); };
        const auto grad = [&](int index) { return load(children + index * BLOCK + i); };
        // `answers` begins with the opacities.
        const auto put = [&](int index, Floats value) { store(answers + (index - at.opacity) * BLOCK + i, value); };
        Floats by_log[6]{};
        for (int child = 0; child < k; ++child) {
            const Floats opacity = row(at.opacity + child);
            put(at.opacity + child, grad(from.opacities + child) * (1.0f - opacity * opacity));
            Floats u[4], matrix[9], by_matrix[9], by_q[4];
            for (int j = 0; j < 4; ++j) u[j] = row(at.shape + 7 * child + 3 + j);
            const Floats unit = per_length(u);
            for (int j = 0; j < 4; ++j) u[j] *= unit;
            rotation(u, matrix);
            for (int axis = 0; axis < 3; ++axis) {
                const Floats share = row(at.shape + 7 * child + axis);
                const Floats scale = row(at.extent + 3 + axis) * share;
                Floats by_scale = grad(from.scales + 3 * child + axis);
                for (int r = 0; r < 3; ++r) {
                    const Floats by_factor = grad(from.factors + 9 * child + 3 * r + axis);
                    by_scale += by_factor * matrix[3 * r + axis];
                    by_matrix[3 * r + axis] = by_factor * scale;
                }
                by_log[3 + axis] += by_scale * scale;
                put(at.shape + 7 * child + axis, by_scale * scale * (1.0f - share));
                const Floats by_mean = grad(from.means + 3 * child + axis), extent = row(at.extent + axis);
                store(by_offset + (3 * child + axis) * BLOCK + i, by_mean * extent);
                by_log[axis] += by_mean * extent * row(at.offset + 3 * child + axis);
                const Floats color = row(at.color + 3 * child + axis);
                put(at.color + 3 * child + axis, grad(from.colors + 3 * child + axis) * color * (1.0f - color));
            }
            turn_back(u, unit, by_matrix, by_q);
            for (int j = 0; j < 4; ++j) put(at.shape + 7 * child + 3 + j, by_q[j]);
        }
        for (int j = 0; j < 6; ++j) store(by_log_scale + j * BLOCK + i, by_log[j]);
    }
}

// Through the heads: adds to the sums by weights, and gives the gradients by the hidden layers.
void head_gradients(const Weights& w, const Rows& at, const float* block, const float* answers, const WeightSums& layout,
                    float* sums, float* by_hidden, float* turned) {
    const int hidden = w.heads.hidden;
    for (int number = 0; number < HEADS; ++number) {
        const int outputs = at.outputs(number), step = layout.step[number];
        const float* const by_answer = answers + (at.answers(number) - at.opacity) * BLOCK;
        const float* const activations = block + number * hidden * BLOCK;
        float* const here = by_hidden + number * hidden * BLOCK;
        multiply({w.head(number).output_weight, 1, hidden}, by_answer, BLOCK, here, BLOCK, hidden, outputs, BLOCK);
        for (int i = 0; i < hidden * BLOCK; i += LANES) {
            store(here + i, where(load(activations + i) > 0.0f, load(here + i)));
        }
        std::fill(turned, turned + BLOCK * step, 0.0f);
        from_lanes(by_answer, outputs, BLOCK, turned, step);
        multiply({activations, BLOCK, 1}, turned, step, sums + layout.second[number], step, hidden, BLOCK, step, true);
        for (int j = 0; j < outputs; ++j) {
            Floats total{};
            for (int i = 0; i < BLOCK; i += LANES) total += load(by_answer + j * BLOCK + i);
            sums[layout.bias[number] + j] += sum(total);
        }
    }
}

void backward_block(const Weights& w, const Rows& at, const SplashAnchors& a, Part part, const float* block,
                    const SplashChildren& grad, const SplashAnchorGradients& out, const WeightSums& layout, float* sums,
                    Scratch& scratch) {
    const int k = at.k, size = w.heads.features, hidden = HEADS * w.heads.hidden, feature_step = in_vectors(size);
    float* const inputs = scratch.inputs.data();
    float* const answers = scratch.answers.data();
    float* const by_hidden = scratch.hidden.data();
    float* const by_feature = scratch.features.data();
    float* const by_log_scale = scratch.tables.data();
    float* const by_offset = by_log_scale + 6 * BLOCK;

    gather_inputs(w, a, part, block + at.direction * BLOCK, inputs);
    gather_children(grad, k, part, scratch.children.data());
    shape_gradients(at, block, scratch.children.data(), answers, by_log_scale, by_offset);
    head_gradients(w, at, block, answers, layout, sums, by_hidden, scratch.turned.data());
    multiply({by_hidden, BLOCK, 1}, inputs, w.first_step, sums, w.first_step, hidden, BLOCK, w.first_step, true);
    multiply({by_hidden, 1, BLOCK}, w.first.data(), w.first_step, by_feature, feature_step, part.count, hidden, feature_step);
    const float* const by_color = answers + (at.color - at.opacity) * BLOCK;
    for (int i = 0; i < part.count; ++i) {
        const int64_t row = row_of(a, part.begin + i);
        float* const feature = by_feature + i * feature_step;
        for (int j = 0; w.heads.base_color != 0 && j < 3 * k; ++j) feature[j % 3] += by_color[j * BLOCK + i];
        std::copy(feature, feature + size, out.features + row * size);
        for (int j = 0; j < 6; ++j) out.log_scales[6 * row + j] = by_log_scale[j * BLOCK + i];
        for (int j = 0; j < 3 * k; ++j) out.offsets[3 * k * row + j] = by_offset[j * BLOCK + i];
    }
}

// Adds the pieces' sums in their order, and takes the matrices apart into the heads' gradients.
void unpack(const Weights& w, const Rows& at, const WeightSums& layout, float* sums, int64_t pieces,
            const SplashAnchorGradients& out) {
    for (int64_t piece = 1; piece < pieces; ++piece) {
        const float* const more = sums + piece * layout.total;
        for (int64_t i = 0; i < layout.total; ++i) sums[i] += more[i];
    }
    const int size = w.heads.features, hidden = w.heads.hidden;
    const SplashHeadGradients heads[HEADS] = {out.opacity, out.shape, out.color};
    const float* row = sums;
    for (int number = 0; number < HEADS; ++number) {
        const SplashHeadGradients& head = heads[number];
        const bool sees = number == HEADS - 1 || w.heads.shape_sees_direction != 0;
        for (int i = 0; i < hidden; ++i, row += w.first_step) {
            float* const weights = head.hidden_weight + i * (size + 3);
            std::copy(row, row + size + 3, weights);
            if (!sees) std::fill(weights + size, weights + size + 3, 0.0f);
            head.hidden_bias[i] = row[size + 3];
        }
        for (int j = 0; j < at.outputs(number); ++j) {
            for (int i = 0; i < hidden; ++i) {
                head.output_weight[j * hidden + i] = sums[layout.second[number] + i * layout.step[number] + j];
            }
            head.output_bias[j] = sums[layout.bias[number] + j];
        }
    }
}

}  // namespace

void decode_anchors_backward(const Weights& w, const SplashAnchors& a, const float* kept, const SplashChildren& grad,
                             int threads, const SplashAnchorGradients& out) {
    const Rows at(w.heads);
    const WeightSums layout(w, at);
    const int64_t pieces = pieces_of(a.count), blocks = blocks_of(a.count);
    static thread_local Buffer<float> buffer;
    float* const sums = buffer.fit(std::max<int64_t>(pieces, 1) * layout.total);
    if (pieces == 0) std::fill(sums, sums + layout.total, 0.0f);
    in_pieces(threads, pieces, 1, [&](int64_t piece, int64_t, int) {
        static thread_local Scratch scratch;
        scratch.inputs.fit(BLOCK * w.first_step);
        scratch.children.fit(ChildRows(at.k).total * BLOCK);
        scratch.answers.fit(11 * at.k * BLOCK);
        scratch.turned.fit(BLOCK * in_vectors(7 * at.k));
        scratch.hidden.fit(HEADS * w.heads.hidden * BLOCK);
        scratch.features.fit(BLOCK * in_vectors(w.heads.features));
        scratch.tables.fit((6 + 3 * at.k) * BLOCK);
        float* const piece_sums = sums + piece * layout.total;
        std::fill(piece_sums, piece_sums + layout.total, 0.0f);
        for (int64_t block = piece * BLOCKS_PER_PIECE; block < std::min(blocks, (piece + 1) * BLOCKS_PER_PIECE); ++block) {
            backward_block(w, at, a, part_of(a.count, block), kept + block * at.total * BLOCK, grad, out, layout, piece_sums,
                           scratch);
        }
    });
    unpack(w, at, layout, sums, pieces, out);
}

}  // namespace splash
