// Static anchors to Gaussians, the forward pass.

#include <algorithm>

#include "anchors.h"
#include "native/elementary.h"
#include "native/multiply.h"
#include "native/threads.h"

namespace splash {
namespace {

struct Scratch {
    Buffer<float> inputs, tables, children;
};

// Extents, offsets and direction of the block's anchors; their positions and features go into `positions` and `inputs`.
void place_anchors(const Weights& w, const Rows& at, const SplashAnchors& a, Part part, float* tables, float* block,
                   float* positions, float* inputs) {
    const int size = w.heads.features, k = at.k;
    const auto gather = [&](const float* source, int width, float* rows) {
        for (int i = 0; i < part.count; ++i) {
            const float* const from = source + row_of(a, part.begin + i) * width;
            std::copy(from, from + width, tables + i * width);
        }
        to_lanes(tables, width, part.count, rows);
    };
    gather(a.features, size, inputs);
    gather(a.log_scales, 6, block + at.extent * BLOCK);
    gather(a.offsets, 3 * k, block + at.offset * BLOCK);
    gather(a.positions, 3, positions);
    std::fill(inputs + (size + 3) * BLOCK, inputs + (size + 4) * BLOCK, 1.0f);
    for (int i = 0; i < BLOCK; i += LANES) {
        Floats direction[3], squares{};
        for (int axis = 0; axis < 3; ++axis) {
            direction[axis] = load(positions + axis * BLOCK + i) - a.eye[axis];
            squares += direction[axis] * direction[axis];
        }
        const Floats scale = 1.0f / max(all(1e-12f), square_root(squares));
        for (int axis = 0; axis < 3; ++axis) {
            store(block + (at.direction + axis) * BLOCK + i, direction[axis] * scale);
            store(inputs + (size + axis) * BLOCK + i, direction[axis] * scale);
        }
        for (int j = 0; j < 6; ++j) {
            float* const extent = block + (at.extent + j) * BLOCK + i;
            store(extent, exp(load(extent)));
        }
    }
}

// The heads' answers, without what is done to them afterwards.
void answer(const Weights& w, const Rows& at, const float* inputs, float* block) {
    const int hidden = w.heads.hidden;
    multiply({w.first.data(), w.first_step, 1}, inputs, BLOCK, block, BLOCK, HEADS * hidden, w.inputs, BLOCK);
    for (int i = 0; i < HEADS * hidden * BLOCK; i += LANES) store(block + i, max(Floats{}, load(block + i)));
    for (int number = 0; number < HEADS; ++number) {
        const SplashHead& head = w.head(number);
        float* const answers = block + at.answers(number) * BLOCK;
        for (int j = 0; j < at.outputs(number); ++j) {
            std::fill(answers + j * BLOCK, answers + (j + 1) * BLOCK, head.output_bias[j]);
        }
        multiply({head.output_weight, hidden, 1}, block + number * hidden * BLOCK, BLOCK, answers, BLOCK, at.outputs(number),
                 hidden, BLOCK, true);
    }
}

// From the heads' answers to the children, in rows: means, factors, scales; opacities and colours stay in the block.
void shape_children(const Weights& w, const Rows& at, const float* positions, const float* inputs, float* block,
                    float* children) {
    const int k = at.k;
    float* const means = children;
    float* const factors = means + 3 * k * BLOCK;
    float* const scales = factors + 9 * k * BLOCK;
    for (int i = 0; i < BLOCK; i += LANES) {
        const auto row = [&](int index) { return block + index * BLOCK + i; };
        for (int child = 0; child < k; ++child) {
            store(row(at.opacity + child), tanh(load(row(at.opacity + child))));
            Floats scale[3], q[4], matrix[9];
            for (int axis = 0; axis < 3; ++axis) {
                float* const answered = row(at.shape + 7 * child + axis);
                store(answered, sigmoid(load(answered)));
                scale[axis] = load(row(at.extent + 3 + axis)) * load(answered);
                store(scales + (3 * child + axis) * BLOCK + i, scale[axis]);
                const Floats moved = load(row(at.offset + 3 * child + axis)) * load(row(at.extent + axis));
                store(means + (3 * child + axis) * BLOCK + i, load(positions + axis * BLOCK + i) + moved);
                float* const color = row(at.color + 3 * child + axis);
                const Floats base = w.heads.base_color ? load(inputs + axis * BLOCK + i) : Floats{};
                store(color, sigmoid(load(color) + base));
            }
            for (int j = 0; j < 4; ++j) q[j] = load(row(at.shape + 7 * child + 3 + j));
            const Floats unit = per_length(q);
            for (int j = 0; j < 4; ++j) q[j] *= unit;
            rotation(q, matrix);
            for (int j = 0; j < 9; ++j) store(factors + (9 * child + j) * BLOCK + i, matrix[j] * scale[j % 3]);
        }
    }
}

void decode_block(const Weights& w, const Rows& at, const SplashAnchors& a, Part part, const SplashChildren& out, float* block,
                  Scratch& scratch) {
    const int k = at.k;
    float* const inputs = scratch.inputs.data();
    float* const children = scratch.children.data();
    alignas(64) float positions[3 * BLOCK];
    place_anchors(w, at, a, part, scratch.tables.data(), block, positions, inputs);
    answer(w, at, inputs, block);
    shape_children(w, at, positions, inputs, block, children);
    const auto put = [&](const float* rows, int width, float* target) {
        from_lanes(rows, width, part.count, target + width * part.begin, width);
    };
    put(children, 3 * k, out.means);
    put(children + 3 * k * BLOCK, 9 * k, out.factors);
    put(children + 12 * k * BLOCK, 3 * k, out.scales);
    put(block + at.opacity * BLOCK, k, out.opacities);
    put(block + at.color * BLOCK, 3 * k, out.colors);
}

}  // namespace

Weights::Weights(const SplashHeads& source) : heads(source), inputs(source.features + 4), first_step(in_vectors(inputs)) {
    const int size = heads.features, hidden = heads.hidden;
    float* row = first.fit(static_cast<size_t>(HEADS) * hidden * first_step);
    std::fill(row, row + static_cast<size_t>(HEADS) * hidden * first_step, 0.0f);
    for (int number = 0; number < HEADS; ++number) {
        const SplashHead& from = head(number);
        const bool sees = number == HEADS - 1 || heads.shape_sees_direction != 0;
        for (int i = 0; i < hidden; ++i, row += first_step) {
            const float* const weights = from.hidden_weight + i * (size + 3);
            std::copy(weights, weights + size + (sees ? 3 : 0), row);
            row[size + 3] = from.hidden_bias[i];
        }
    }
}

void decode_anchors(const Weights& w, const SplashAnchors& a, const SplashChildren& out, float* kept, int threads) {
    const Rows at(w.heads);
    const int64_t pieces = pieces_of(a.count), blocks = blocks_of(a.count);
    in_pieces(threads, pieces, 1, [&](int64_t piece, int64_t, int) {
        static thread_local Scratch scratch;
        static thread_local Buffer<float> dropped;
        scratch.inputs.fit(w.inputs * BLOCK);
        scratch.tables.fit(BLOCK * std::max({w.heads.features, 6, 3 * at.k}));
        scratch.children.fit(15 * at.k * BLOCK);
        for (int64_t block = piece * BLOCKS_PER_PIECE; block < std::min(blocks, (piece + 1) * BLOCKS_PER_PIECE); ++block) {
            float* const here = kept == nullptr ? dropped.fit(at.total * BLOCK) : kept + block * at.total * BLOCK;
            decode_block(w, at, a, part_of(a.count, block), out, here, scratch);
        }
    });
}

}  // namespace splash
