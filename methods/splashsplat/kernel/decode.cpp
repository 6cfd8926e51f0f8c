// Carriers to Gaussians, the forward pass.

#include "decode.h"

#include <algorithm>
#include <cmath>

#include "native/multiply.h"
#include "native/elementary.h"
#include "native/threads.h"

namespace splash {
namespace {

// One block's children as rows of BLOCK floats, before they are written carrier by carrier.
struct Scratch {
    Buffer<float> inputs, children;
};

// Rows of the products' right factor: features, direction, one.
void gather_inputs(const Weights& w, const SplashCarriers& c, Part part, const float* direction, float* inputs) {
    const int size = w.heads.features;
    for (int i = 0; i < part.count; ++i) {
        const float* const feature = c.features + row_of(c, part.begin + i) * size;
        prefetch_features(c, size, part.begin + i);
        for (int j = 0; j < size; ++j) inputs[j * BLOCK + i] = feature[j];
    }
    for (int j = 0; j < size; ++j) std::fill(inputs + j * BLOCK + part.count, inputs + (j + 1) * BLOCK, 0.0f);
    std::copy(direction, direction + 3 * BLOCK, inputs + size * BLOCK);
    std::fill(inputs + (size + 3) * BLOCK, inputs + (size + 4) * BLOCK, 1.0f);
}

// Scale, fade and direction of the block's carriers.
void place_carriers(const Weights& w, const Rows& at, const SplashCarriers& c, Part part, float* block, float* positions) {
    float logs[3 * BLOCK];
    for (int i = 0; i < part.count; ++i) {
        const int64_t row = row_of(c, part.begin + i);
        for (int axis = 0; axis < 3; ++axis) logs[3 * i + axis] = c.log_scales[3 * row + axis];
    }
    to_lanes(logs, 3, part.count, block + at.base * BLOCK);
    to_lanes(c.deformation + 9 * part.begin, 9, part.count, block + at.deformation * BLOCK);
    to_lanes(c.positions + 3 * part.begin, 3, part.count, positions);
    float* const fade = block + at.fade * BLOCK;
    to_lanes(c.phi + part.begin, 1, part.count, fade);
    alignas(64) float visibility[BLOCK];
    std::fill(visibility, visibility + BLOCK, 1.0f);
    if (c.visibility != nullptr) std::copy(c.visibility + part.begin, c.visibility + part.begin + part.count, visibility);
    for (int i = 0; i < BLOCK; i += LANES) {
        Floats direction[3], squares{};
        for (int axis = 0; axis < 3; ++axis) {
            float* const base = block + (at.base + axis) * BLOCK + i;
            store(base, exp(load(base)));
            direction[axis] = load(positions + axis * BLOCK + i) - c.eye[axis];
            squares += direction[axis] * direction[axis];
        }
        const Floats per_length = 1.0f / max(all(1e-12f), square_root(squares));
        for (int axis = 0; axis < 3; ++axis) store(block + (at.direction + axis) * BLOCK + i, direction[axis] * per_length);
        const Floats above = w.heads.opacity_band - absolute(load(fade + i));
        store(fade + i, sigmoid(w.heads.opacity_slope * above) * load(visibility + i));
    }
}

// From the heads' answers to the children, in rows: means, factors, opacities, offsets.
void shape_children(const Weights& w, const Rows& at, float* block, const float* positions, float* children) {
    const int k = at.k;
    const float per_root = 1.0f / std::sqrt(static_cast<float>(k));
    float* const means = children;
    float* const factors = means + 3 * k * BLOCK;
    float* const opacities = factors + 9 * k * BLOCK;
    float* const offsets = opacities + k * BLOCK;
    for (int i = 0; i < BLOCK; i += LANES) {
        const auto row = [&](int index) { return block + index * BLOCK + i; };
        Floats F[9], base[3];
        for (int j = 0; j < 9; ++j) F[j] = load(row(at.deformation + j));
        for (int axis = 0; axis < 3; ++axis) base[axis] = load(row(at.base + axis));
        const Floats fade = load(row(at.fade));
        for (int child = 0; child < k; ++child) {
            Floats local[3];
            for (int axis = 0; axis < 3; ++axis) {
                const int j = 3 * child + axis;
                const Floats bounded = tanh(load(row(at.offset + j)));
                store(row(at.offset + j), bounded);
                const Floats offset = w.heads.offset_bound * bounded;
                store(offsets + j * BLOCK + i, offset);
                local[axis] = base[axis] * offset;
                const Floats residual = tanh(0.5f * load(row(at.scale + j)));
                store(row(at.scale + j), residual);
                const Floats extent = per_root * base[axis] * exp(2.0f * w.heads.scale_range * residual);
                store(row(at.extent + j), extent);
                for (int r = 0; r < 3; ++r) store(factors + (9 * child + 3 * r + axis) * BLOCK + i, F[3 * r + axis] * extent);
            }
            for (int r = 0; r < 3; ++r) {
                const Floats moved = F[3 * r] * local[0] + F[3 * r + 1] * local[1] + F[3 * r + 2] * local[2];
                store(means + (3 * child + r) * BLOCK + i, load(positions + r * BLOCK + i) + moved);
            }
            const Floats learned = sigmoid(load(row(at.opacity + child)));
            store(row(at.opacity + child), learned);
            store(opacities + child * BLOCK + i, learned * fade);
        }
        for (int j = 0; j < w.heads.hidden; ++j) store(row(at.hidden + j), max(Floats{}, load(row(at.hidden + j))));
    }
}

// Sums over the block of the covariances' traces and of the squared hinges of the children's distances.
void add_penalties(const Weights& w, const Rows& at, const float* block, const float* offsets, Part part, double sums[2]) {
    const Floats margin = all(w.heads.separation_margin), lane = ramp();
    for (int i = 0; i < part.count; i += LANES) {
        const auto row = [&](int index) { return load(block + index * BLOCK + i); };
        Floats trace{}, hinge{};
        for (int axis = 0; axis < 3; ++axis) {
            Floats squares{};
            for (int r = 0; r < 3; ++r) squares += row(at.deformation + 3 * r + axis) * row(at.deformation + 3 * r + axis);
            for (int child = 0; child < at.k; ++child) {
                const Floats extent = row(at.extent + 3 * child + axis);
                trace += squares * extent * extent;
            }
        }
        for (int a = 0; a < at.k; ++a) {
            for (int b = a + 1; b < at.k; ++b) {
                Floats squares{};
                for (int axis = 0; axis < 3; ++axis) {
                    const Floats apart = load(offsets + (3 * a + axis) * BLOCK + i) - load(offsets + (3 * b + axis) * BLOCK + i);
                    squares += apart * apart;
                }
                const Floats short_of = max(Floats{}, margin - square_root(max(all(1e-12f), squares)));
                hinge += short_of * short_of;
            }
        }
        const Ints there = lane < static_cast<float>(part.count - i);
        sums[0] += sum(where(there, trace));
        sums[1] += sum(where(there, hinge));
    }
}

void decode_block(const Weights& w, const Rows& at, const SplashCarriers& c, Part part, const SplashChildren& out,
                  float* block, Scratch& scratch, double sums[2]) {
    const int k = at.k;
    float* const inputs = scratch.inputs.data();
    float* const children = scratch.children.data();
    alignas(64) float positions[3 * BLOCK];
    place_carriers(w, at, c, part, block, positions);
    gather_inputs(w, c, part, block + at.direction * BLOCK, inputs);
    multiply({w.first.data(), w.first_step, 1}, inputs, BLOCK, block, BLOCK, w.outputs, w.inputs, BLOCK);
    std::fill(block + at.one * BLOCK, block + (at.one + 1) * BLOCK, 1.0f);
    shape_children(w, at, block, positions, children);
    float* const colors = block + at.color * BLOCK;
    multiply({w.second.data(), w.second_step, 1}, block + at.hidden * BLOCK, BLOCK, colors, BLOCK, 3 * k, w.heads.hidden + 1,
             BLOCK);
    for (int i = 0; i < 3 * k * BLOCK; i += LANES) store(colors + i, sigmoid(load(colors + i)));
    const float* const factors = children + 3 * k * BLOCK;
    const float* const opacities = factors + 9 * k * BLOCK;
    const float* const offsets = opacities + k * BLOCK;
    from_lanes(children, 3 * k, part.count, out.means + 3 * k * part.begin, 3 * k);
    from_lanes(factors, 9 * k, part.count, out.factors + 9 * k * part.begin, 9 * k);
    from_lanes(opacities, k, part.count, out.opacities + k * part.begin, k);
    from_lanes(offsets, 3 * k, part.count, out.offsets + 3 * k * part.begin, 3 * k);
    from_lanes(colors, 3 * k, part.count, out.colors + 3 * k * part.begin, 3 * k);
    if (c.cells != nullptr) add_penalties(w, at, block, offsets, part, sums);
}

// Mean colour of each cell, and the mean squared distance of all colours from their cell's.
double color_variance(const SplashCarriers& c, int k, const float* colors, float* cell_colors, int threads) {
    Buffer<float> populations;
    std::fill(cell_colors, cell_colors + 3 * c.cell_count, 0.0f);
    float* const population = populations.fit(c.cell_count);
    std::fill(population, population + c.cell_count, 0.0f);
    for (int64_t i = 0; i < c.count; ++i) {
        float* const cell = cell_colors + 3 * c.cells[i];
        for (int child = 0; child < k; ++child) {
            for (int channel = 0; channel < 3; ++channel) cell[channel] += colors[3 * (i * k + child) + channel];
        }
        population[c.cells[i]] += static_cast<float>(k);
    }
    for (int64_t i = 0; i < c.cell_count; ++i) {
        for (int channel = 0; channel < 3; ++channel) cell_colors[3 * i + channel] /= population[i];
    }
    const int64_t pieces = pieces_of(c.count), grain = BLOCK * BLOCKS_PER_PIECE;
    Buffer<double> sums;
    sums.fit(pieces);
    in_pieces(threads, pieces, 1, [&](int64_t piece, int64_t, int) {
        double total = 0.0;
        for (int64_t i = piece * grain; i < std::min(c.count, (piece + 1) * grain); ++i) {
            const float* const cell = cell_colors + 3 * c.cells[i];
            float squares = 0.0f;
            for (int j = 0; j < 3 * k; ++j) {
                const float off = colors[3 * k * i + j] - cell[j % 3];
                squares += off * off;
            }
            total += squares;
        }
        sums[piece] = total;
    });
    double total = 0.0;
    for (int64_t piece = 0; piece < pieces; ++piece) total += sums[piece];
    return total / static_cast<double>(3 * k * c.count);
}

}  // namespace

Weights::Weights(const SplashHeads& source)
    : heads(source),
      inputs(source.features + 4),
      outputs(7 * source.children + source.hidden),
      first_step(in_vectors(inputs)),
      second_step(source.hidden + 1) {
    const int size = heads.features, k = heads.children;
    float* row = first.fit(static_cast<size_t>(outputs) * first_step);
    std::fill(row, row + static_cast<size_t>(outputs) * first_step, 0.0f);
    const auto add = [&](const float* weight, const float* bias, int count, int width) {
        for (int i = 0; i < count; ++i, row += first_step) {
            std::copy(weight + i * width, weight + (i + 1) * width, row);
            row[size + 3] = bias[i];
        }
    };
    add(heads.offset_weight, heads.offset_bias, 3 * k, size);
    add(heads.scale_weight, heads.scale_bias, 3 * k, size);
    add(heads.opacity_weight, heads.opacity_bias, k, size);
    add(heads.hidden_weight, heads.hidden_bias, heads.hidden, size + 3);
    second.fit(static_cast<size_t>(3) * k * second_step);
    for (int i = 0; i < 3 * k; ++i) {
        std::copy(heads.color_weight + i * heads.hidden, heads.color_weight + (i + 1) * heads.hidden,
                  &second[i * second_step]);
        second[i * second_step + heads.hidden] = heads.color_bias[i];
    }
}

void decode(const Weights& w, const SplashCarriers& c, const SplashChildren& out, float* kept, float* cell_colors,
            double penalties[3], int threads) {
    const Rows at(w.heads);
    const int64_t pieces = pieces_of(c.count), blocks = blocks_of(c.count);
    Buffer<double> sums;
    sums.fit(2 * pieces);
    in_pieces(threads, pieces, 1, [&](int64_t piece, int64_t, int) {
        static thread_local Scratch scratch;
        static thread_local Buffer<float> dropped;
        scratch.inputs.fit(w.inputs * BLOCK);
        scratch.children.fit(16 * at.k * BLOCK);
        double piece_sums[2] = {0.0, 0.0};
        for (int64_t block = piece * BLOCKS_PER_PIECE; block < std::min(blocks, (piece + 1) * BLOCKS_PER_PIECE); ++block) {
            float* const here = kept == nullptr ? dropped.fit(at.total * BLOCK) : kept + block * at.total * BLOCK;
            decode_block(w, at, c, part_of(c.count, block), out, here, scratch, piece_sums);
        }
        sums[2 * piece] = piece_sums[0];
        sums[2 * piece + 1] = piece_sums[1];
    });
    if (c.cells == nullptr) return;
    const int pairs = at.k * (at.k - 1) / 2;
    penalties[0] = penalties[1] = penalties[2] = 0.0;
    if (c.count == 0) return;
    for (int64_t piece = 0; piece < pieces; ++piece) {
        penalties[0] += sums[2 * piece];
        penalties[1] += sums[2 * piece + 1];
    }
    penalties[0] /= static_cast<double>(c.count * at.k);
    penalties[1] /= static_cast<double>(c.count * std::max(pairs, 1));
    penalties[2] = color_variance(c, at.k, out.colors, cell_colors, threads);
}

}  // namespace splash
