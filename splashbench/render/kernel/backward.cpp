// Step 5: the gradients, first within tiles and then from splats to Gaussians.
//
// Given the gradients g by a pixel's colour and g_o by its opacity, back to front with T taken back by division,
//     dL/dc_i = weight_i g,    dL/dalpha_i = T_i g . c_i - rest_i / (1 - alpha_i),
// where rest_i = sum_{j > i} weight_j g . c_j + T_end (g . background - g_o) is what lies behind. With
// v = alpha dL/dalpha = dL/dlog(alpha), 0 where alpha was clamped, and u and dy as in footprint.h, a tile gives each of its
// splats the moments sum v, v u, v u^2, v dy, v u dy, v dy^2.

#include <algorithm>
#include <cstring>

#include "footprint.h"
#include "frame.h"
#include "native/elementary.h"
#include "native/simd.h"
#include "native/threads.h"
#include "projection.h"
#include "thresholds.h"

namespace splash {
namespace {

// A tile's pixels, vector by vector: [TILE_VECTORS, 2 + channels, LANES], the transmittance and the rest behind the layer
// at hand, then the gradients by the colours; together for the reason given in blend.cpp.
inline int gradient_cell_size(int channels) { return (2 + channels) * LANES; }

// The largest stop of each vector and of the tile: layers from there on are invisible in it.
struct Stops {
    int32_t vector[TILE_VECTORS];
    int32_t tile;
};

void find_stops(const int32_t* stops, int count, Stops& largest_stops) {
    largest_stops.tile = 0;
    for (int vector = 0; vector < TILE_VECTORS; ++vector) {
        const int32_t stop = std::min(count, largest(load(stops + vector * LANES)));
        largest_stops.vector[vector] = stop;
        largest_stops.tile = std::max(largest_stops.tile, stop);
    }
}

// Begins a tile's cells: T_end, the outer gradients, and as the rest T_end (g . background - g_o).
void begin_cells(const Frame& frame, int tile, int channels, const float* grad_color, const float* grad_opacity,
                 float* cells) {
    const TileFrame at = tile_frame(frame, tile);
    const float* const transmittance = frame.transmittance.data() + static_cast<int64_t>(frame.places[tile]) * TILE_PIXELS;
    const int64_t place = frame.compact ? frame.compact_places[tile] : 0;
    const int size = gradient_cell_size(channels);
    std::memset(cells, 0, sizeof(float) * TILE_VECTORS * size);
    // Distances between the pixels and between the channels of grad_color.
    const int64_t by_pixel = frame.compact ? 1 : frame.channels, by_channel = frame.compact ? TILE_PIXELS : 1;
    const int behind_by_pixel = frame.background_per_pixel ? frame.channels : 0;
    for (int row = 0; row < at.rows; ++row) {
        for (int first = 0; first < at.columns; first += LANES) {
            const int lanes = std::min(LANES, at.columns - first), pixel = row * TILE_WIDTH + first;
            const int64_t image_pixel = static_cast<int64_t>(at.y + row) * frame.camera.width + at.x + first;
            float* const cell = cells + pixel / LANES * size;
            float* const rest = cell + LANES;
            for (int channel = 0; channel < channels; ++channel) {
                const float* const from = grad_color + channel * by_channel +
                                          (frame.compact ? place * frame.channels * TILE_PIXELS + pixel : image_pixel * by_pixel);
                float* const g = cell + (2 + channel) * LANES;
                for (int lane = 0; lane < lanes; ++lane) g[lane] = from[lane * by_pixel];
                if (frame.background == nullptr) continue;
                const float* const behind = frame.background_at(image_pixel) + channel;
                for (int lane = 0; lane < lanes; ++lane) rest[lane] += g[lane] * behind[lane * behind_by_pixel];
            }
            if (grad_opacity != nullptr) {
                const float* const from = grad_opacity + (frame.compact ? place * TILE_PIXELS + pixel : image_pixel);
                for (int lane = 0; lane < lanes; ++lane) rest[lane] -= from[lane];
            }
            for (int lane = 0; lane < lanes; ++lane) {
                cell[lane] = transmittance[pixel + lane];
                rest[lane] *= cell[lane];
            }
        }
    }
}

// Takes one layer back. CHANNELS and CLAMPED as in blend.cpp; FROZEN layers get no gradients themselves.
// slot: its moments and the channels' gradients, overwritten.
template <int CHANNELS, bool FROZEN, bool CLAMPED>
inline void take_back(const Layer& layer, int index, const TileFrame& tile, const Footprint& f, const int32_t* stops,
                      const Stops& largest_stops, const float* columns, int channels, float* cells, float* slot) {
    if (CHANNELS >= 0) channels = CHANNELS;
    const Floats root = all(layer.splat->root), zero = all(0.0f);
    const float y = static_cast<float>(layer.splat->y - 0.5 - tile.y);
    Floats m = zero, mu = zero, muu = zero, my = zero, muy = zero, myy = zero;
    Floats color_sums[CHANNELS >= 0 ? CHANNELS + 1 : MAX_CHANNELS];
    for (int channel = 0; channel < channels; ++channel) color_sums[channel] = zero;
    for (int row = f.top; row <= f.bottom; ++row) {
        const Floats shift = all(f.shift[row]), peak = all(f.peak[row]);
        Floats row_m = zero, row_mu = zero, row_muu = zero;
        for (int vector = f.first[row]; vector <= f.last[row]; ++vector) {
            if (index >= largest_stops.vector[vector]) continue;
            float* const cell = cells + vector * gradient_cell_size(channels);
            const Floats u = root * load(columns + static_cast<uint32_t>(vector) % VECTORS * LANES) - shift;
            const Floats square = u * u;
            const Floats exponent = peak - square;
            const Ints drawn = (exponent >= THRESHOLDS.log2_min_alpha) & (load(stops + vector * LANES) > index);
            const Floats raw = exp2(exponent);
            const Floats alpha = where(drawn, CLAMPED ? min(raw, THRESHOLDS.max_alpha) : raw);
            const Floats per_kept = THRESHOLDS.one / (THRESHOLDS.one - alpha);
            const Floats rest = load(cell + LANES);
            Floats by_alpha = -per_kept * rest;
            if (channels > 0) {
                const Floats t = load(cell) * per_kept;
                store(cell, t);
                const Floats weight = alpha * t;
                Floats here = zero;
                for (int channel = 0; channel < channels; ++channel) {
                    const Floats g = load(cell + (2 + channel) * LANES);
                    here += g * layer.color[channel];
                    if (!FROZEN) color_sums[channel] += weight * g;
                }
                store(cell + LANES, rest + weight * here);
                by_alpha += t * here;
            }
            if (FROZEN) continue;
            Floats v = alpha * by_alpha;
            if (CLAMPED) v = where(raw <= THRESHOLDS.max_alpha, v);
            row_m += v;
            row_mu += v * u;
            row_muu += v * square;
        }
        const float dy = row - y;
        m += row_m;
        mu += row_mu;
        muu += row_muu;
        my += row_m * dy;
        muy += row_mu * dy;
        myy += row_m * (dy * dy);
    }
    if (FROZEN) return;
    slot[0] = sum(m);
    slot[1] = sum(mu);
    slot[2] = sum(muu);
    slot[3] = sum(my);
    slot[4] = sum(muy);
    slot[5] = sum(myy);
    for (int channel = 0; channel < channels; ++channel) slot[MOMENTS + channel] = sum(color_sums[channel]);
}

// All layers of a tile. In an opacity tile (CHANNELS 0) the channels' slots are zero, and frozen layers change nothing:
// what lies behind enters `rest` through the tile's last transmittance alone.
template <int CHANNELS>
void tile_gradients(Frame& frame, const std::vector<Layer>& layers, int tile, int channels, float* cells) {
    if (CHANNELS >= 0) channels = CHANNELS;
    const TileFrame at = tile_frame(frame, tile);
    const int32_t* const stops = frame.stops.data() + static_cast<int64_t>(frame.places[tile]) * TILE_PIXELS;
    const int count = static_cast<int>(layers.size());
    const int stride = slot_size(frame.channels);
    Stops largest_stops;
    find_stops(stops, count, largest_stops);
    alignas(64) float columns[TILE_WIDTH];
    number_columns(columns);
    const auto slot_of = [&](const Layer& layer) { return frame.slots.data() + static_cast<int64_t>(layer.slot) * stride; };
    for (int index = largest_stops.tile; index < count; ++index) {
        if (layers[index].slot >= 0) std::memset(slot_of(layers[index]), 0, sizeof(float) * stride);
    }
    Footprint f;
    for (int index = largest_stops.tile - 1; index >= 0; --index) {
        if (index >= AHEAD) prefetch(layers[index - AHEAD].splat);
        const Layer& layer = layers[index];
        if (layer.slot < 0) {
            if (channels == 0) continue;
            find_footprint(*layer.splat, at, f);
            take_back<CHANNELS, true, true>(layer, index, at, f, stops, largest_stops, columns, channels, cells, nullptr);
            continue;
        }
        float* const slot = slot_of(layer);
        find_footprint(*layer.splat, at, f);
        if (may_clamp(*layer.splat)) {
            take_back<CHANNELS, false, true>(layer, index, at, f, stops, largest_stops, columns, channels, cells, slot);
        } else {
            take_back<CHANNELS, false, false>(layer, index, at, f, stops, largest_stops, columns, channels, cells, slot);
        }
        if (channels < frame.channels) std::memset(slot + MOMENTS + channels, 0, sizeof(float) * (frame.channels - channels));
    }
}

void tile_gradients_any(Frame& frame, const std::vector<Layer>& layers, int tile, int channels, float* cells) {
    switch (channels) {
        case 0: return tile_gradients<0>(frame, layers, tile, 0, cells);
        case 1: return tile_gradients<1>(frame, layers, tile, 1, cells);
        case 3: return tile_gradients<3>(frame, layers, tile, 3, cells);
        case 4: return tile_gradients<4>(frame, layers, tile, 4, cells);
        default: return tile_gradients<-1>(frame, layers, tile, channels, cells);
    }
}

inline void put(float* at, Vector value, bool add) {
    at[0] = add ? at[0] + value.x : value.x;
    at[1] = add ? at[1] + value.y : value.y;
    at[2] = add ? at[2] + value.z : value.z;
}

// From a splat's summed slots to its Gaussian.
//
// With d the offset of a pixel and w = Sigma^-1 d = (k u, dy / yy - slope k u), k = 2 ln(2) root, the mean in the image
// gets sum v w and Sigma gets sum v w w^T / 2.
// Sigma = P P^T + blur gives dL/dP = 2 dL/dSigma P, and P = J R B gives B and J.
void gaussian_gradient(const Frame& frame, int64_t i, const Splat& s, const float* sums, const SplashGradients& out) {
    const SplashGaussians& g = frame.gaussians;
    const Camera& camera = frame.camera;
    const bool add = out.add != 0;
    const float k = 2.0f * LN_2 * s.root, per_yy = 2.0f * LN_2 * s.fall;
    const float m = sums[0], mu = sums[1], muu = sums[2], my = sums[3], muy = sums[4], myy = sums[5];
    const float grad_u = k * mu, grad_v = per_yy * my - s.slope * grad_u;
    const float wxx = k * k * muu, wxy = k * per_yy * muy - s.slope * wxx;
    const float wyy = per_yy * per_yy * myy - 2.0f * s.slope * k * per_yy * muy + s.slope * s.slope * wxx;

    const float* const factor = g.factors + 9 * i;
    const Linearised l = linearise(camera, in_camera(camera, g.means + 3 * i), factor);
    // dL/dSigma is half of (wxx, wxy, wyy); the factor 2 of dL/dP makes up for it.
    const Vector grad_p = wxx * l.p + wxy * l.q, grad_q = wxy * l.p + wyy * l.q;
    float* const grad_factor = out.factors + 9 * i;
    put(grad_factor, l.a.x * grad_p + l.b.x * grad_q, add);
    put(grad_factor + 3, l.a.y * grad_p + l.b.y * grad_q, add);
    put(grad_factor + 6, l.a.z * grad_p + l.b.z * grad_q, add);
    const Vector grad_a = {dot(row(factor, 0), grad_p), dot(row(factor, 1), grad_p), dot(row(factor, 2), grad_p)};
    const Vector grad_b = {dot(row(factor, 0), grad_q), dot(row(factor, 1), grad_q), dot(row(factor, 2), grad_q)};

    const Vector right = row(camera.rotation, 0), down = row(camera.rotation, 1), forward = row(camera.rotation, 2);
    const float fx_z = camera.fx * l.per_z, fy_z = camera.fy * l.per_z;
    const float grad_jx = dot(grad_a, right), grad_jxz = dot(grad_a, forward);
    const float grad_jy = dot(grad_b, down), grad_jyz = dot(grad_b, forward);
    float grad_x = fx_z * grad_u, grad_y = fy_z * grad_v;
    float grad_z = -l.per_z * (grad_x * l.x + grad_y * l.y);
    grad_z += l.per_z * (fx_z * (l.tx * grad_jxz - grad_jx) + fy_z * (l.ty * grad_jyz - grad_jy));
    if (l.tx == l.x * l.per_z) {
        grad_x -= fx_z * l.per_z * grad_jxz;
        grad_z += fx_z * l.per_z * l.tx * grad_jxz;
    }
    if (l.ty == l.y * l.per_z) {
        grad_y -= fy_z * l.per_z * grad_jyz;
        grad_z += fy_z * l.per_z * l.ty * grad_jyz;
    }
    if (frame.with_depth) grad_z += sums[MOMENTS + g.channels];
    put(out.means + 3 * i, grad_x * right + grad_y * down + grad_z * forward, add);

    const float grad_opacity = m / g.opacities[i];
    out.opacities[i] = add ? out.opacities[i] + grad_opacity : grad_opacity;
    for (int channel = 0; channel < g.channels; ++channel) {
        float& grad = out.colors[i * g.channels + channel];
        grad = add ? grad + sums[MOMENTS + channel] : sums[MOMENTS + channel];
    }
}

// Zero gradients for the Gaussians [begin, end).
void clear(int64_t begin, int64_t end, int channels, const SplashGradients& out) {
    const size_t bytes = sizeof(float) * (end - begin);
    std::memset(out.means + 3 * begin, 0, 3 * bytes);
    std::memset(out.factors + 9 * begin, 0, 9 * bytes);
    std::memset(out.opacities + begin, 0, bytes);
    if (channels > 0) std::memset(out.colors + begin * channels, 0, channels * bytes);
}

}  // namespace

void backward(Frame& frame, const float* grad_color, const float* grad_opacity, const SplashGradients& gradients) {
    const int stride = slot_size(frame.channels);
    frame.slots.fit(static_cast<size_t>(frame.tile_starts[frame.tiles]) * stride);
    in_pieces(frame.threads, frame.placed, 1, [&](int64_t begin, int64_t end, int) {
        Scratch& scratch = this_threads_scratch();
        float* const cells = scratch.cells.fit(static_cast<size_t>(TILE_VECTORS) * gradient_cell_size(frame.channels));
        for (int64_t at = begin; at < end; ++at) {
            const int tile = frame.order[at];
            const int channels = frame.modes[tile] == COLOR && grad_color != nullptr ? frame.channels : 0;
            merged_list(frame, tile, scratch.layers);
            begin_cells(frame, tile, channels, grad_color, grad_opacity, cells);
            tile_gradients_any(frame, scratch.layers, tile, channels, cells);
        }
    });
    constexpr int64_t GRAIN = 1024;
    in_pieces(frame.threads, frame.gaussians.count, GRAIN, [&](int64_t begin, int64_t end, int) {
        typedef float Four __attribute__((vector_size(16)));
        alignas(16) float sums[(MOMENTS + MAX_CHANNELS + 3) / 4 * 4];
        for (int64_t i = begin; i < end; ++i) {
            if (frame.keys[i] == NOT_DRAWN) {
                int64_t past = i + 1;
                while (past < end && frame.keys[past] == NOT_DRAWN) ++past;
                if (!gradients.add) clear(i, past, frame.gaussians.channels, gradients);
                i = past - 1;
                continue;
            }
            if (i + 8 < end && frame.keys[i + 8] != NOT_DRAWN) {
                const int32_t rank = frame.ranks[i + 8];
                prefetch(&frame.splats[rank]);
                prefetch(frame.slots.data() + static_cast<int64_t>(frame.slot_starts[rank]) * stride);
            }
            const int32_t rank = frame.ranks[i];
            const int32_t first = frame.slot_starts[rank], past = frame.slot_starts[rank + 1];
            for (int part = 0; part < stride; part += 4) {
                const float* slot = frame.slots.data() + static_cast<int64_t>(first) * stride + part;
                Four sum = *reinterpret_cast<const Four*>(slot);
                for (int32_t next = first + 1; next < past; ++next) {
                    slot += stride;
                    sum += *reinterpret_cast<const Four*>(slot);
                }
                *reinterpret_cast<Four*>(sums + part) = sum;
            }
            gaussian_gradient(frame, i, frame.splats[rank], sums, gradients);
        }
    });
}

}  // namespace splash
