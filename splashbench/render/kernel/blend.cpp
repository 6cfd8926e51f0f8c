// Step 4: alpha compositing, front to back, tile by tile.
//
// At each pixel, over the splats i of the tile's list, front to back:
//     alpha_i = min(opacity_i exp(-d^T Sigma_i^-1 d / 2), MAX_ALPHA), skipped below MIN_ALPHA,
//     weight_i = alpha_i T_i,    T_{i+1} = T_i - weight_i,    T_0 = 1,
//     colour = sum_i weight_i c_i + T background,    opacity = 1 - T,
// until a splat would bring T to MIN_TRANSMITTANCE or below: that one and all behind it are left out, and its index in
// the list is the pixel's stop.

#include <algorithm>
#include <cstring>

#include "footprint.h"
#include "frame.h"
#include "native/simd.h"
#include "native/threads.h"
#include "thresholds.h"

namespace splash {

void merged_list(const Frame& frame, int tile, std::vector<Layer>& layers) {
    const auto layer = [](const Frame& of, const Entry& entry, bool frozen) {
        const Splat* const splat = &of.splats[entry.splat];
        const float* const color =
            of.table_colors ? of.channel_table.data() + static_cast<int64_t>(entry.splat) * of.channels : splat->color;
        return Layer{splat, color, frozen ? -1 : entry.slot};
    };
    layers.clear();
    const Entry* here = frame.entries.data() + frame.tile_starts[tile];
    const Entry* const end = frame.entries.data() + frame.tile_starts[tile + 1];
    if (frame.frozen != nullptr) {
        const Frame& other = *frame.frozen;
        const Entry* there = other.entries.data() + other.tile_starts[tile];
        const Entry* const other_end = other.entries.data() + other.tile_starts[tile + 1];
        while (here != end && there != other_end) {
            if (frame.splats[here->splat].depth <= other.splats[there->splat].depth) {
                layers.push_back(layer(frame, *here++, false));
            } else {
                layers.push_back(layer(other, *there++, true));
            }
        }
        for (; there != other_end; ++there) layers.push_back(layer(other, *there, true));
    }
    for (; here != end; ++here) layers.push_back(layer(frame, *here, false));
}

namespace {

// Which vectors of a tile still have a pixel that is not exhausted, and how many have.
struct Alive {
    uint8_t vector[TILE_VECTORS];
    int count;
};

// A tile's pixels, vector by vector: [TILE_VECTORS, 1 + channels, LANES], transmittance first, then the colours. What a
// layer reads and writes of a pixel lies together: in planes of their own, at distances of a power of two, the values
// would compete for the same few lines of the cache.
inline int cell_size(int channels) { return (1 + channels) * LANES; }

// A tile's state before its first splat. A pixel with T <= 0 is exhausted (its transmittance is -T), as are those
// beyond the image from the start.
void begin_tile(const TileFrame& tile, int channels, float* cells, int32_t* stops, Alive& alive) {
    alive.count = 0;
    std::memset(cells, 0, sizeof(float) * TILE_VECTORS * cell_size(channels));
    for (int vector = 0; vector < TILE_VECTORS; ++vector) {
        const int row = vector / VECTORS, column = vector % VECTORS * LANES;
        const bool inside = row < tile.rows && column < tile.columns;
        alive.vector[vector] = inside;
        alive.count += inside;
        for (int lane = 0; lane < LANES; ++lane) {
            const bool pixel_inside = inside && column + lane < tile.columns;
            cells[vector * cell_size(channels) + lane] = pixel_inside ? 1.0f : -1.0f;
            stops[vector * LANES + lane] = pixel_inside ? INT32_MAX : 0;
        }
    }
}

// Pixels of a vector that layer `index` exhausts: they keep their transmittance, marked, and their stop.
__attribute__((noinline)) void exhaust(Ints exhausted, int index, int vector, float* transmittance, int32_t* stops,
                                       Alive& alive) {
    const Floats t = load(transmittance);
    const Floats marked = exhausted ? -t : t;
    store(transmittance, marked);
    store(stops + vector * LANES, exhausted ? all(index) : load(stops + vector * LANES));
    if (any(marked > 0.0f)) return;
    alive.vector[vector] = 0;
    --alive.count;
}

// Adds one layer to the pixels it covers. CHANNELS: 0 opacity alone, -1 as many as `channels` says. CLAMPED: whether its
// alpha can reach MAX_ALPHA. WEIGHED: returns the sum of its weights, each times its pixel's `counts`; else 0.
template <int CHANNELS, bool CLAMPED, bool WEIGHED>
inline float add_layer(const Layer& layer, int index, const Footprint& f, const float* columns, int channels, float* cells,
                       int32_t* stops, Alive& alive, const float* counts) {
    if (CHANNELS >= 0) channels = CHANNELS;
    Floats weights = all(0.0f);
    const Floats root = all(layer.splat->root);
    for (int row = f.top; row <= f.bottom; ++row) {
        const Floats shift = all(f.shift[row]), peak = all(f.peak[row]);
        for (int vector = f.first[row]; vector <= f.last[row]; ++vector) {
            if (!alive.vector[vector]) continue;
            float* const cell = cells + vector * cell_size(channels);
            const Floats u = root * load(columns + static_cast<uint32_t>(vector) % VECTORS * LANES) - shift;
            const Floats exponent = peak - u * u;
            const Floats t = load(cell);
            const Ints drawn = (exponent >= THRESHOLDS.log2_min_alpha) & (t > 0.0f);
            Floats alpha = exp2(exponent);
            if (CLAMPED) alpha = min(alpha, THRESHOLDS.max_alpha);
            Floats weight = where(drawn, alpha * t);
            const Floats behind = t - weight;
            const Ints exhausted = drawn & (behind <= THRESHOLDS.min_transmittance);
            if (__builtin_expect(any(exhausted), 0)) {
                weight = where(~exhausted, weight);
                store(cell, t - weight);
                exhaust(exhausted, index, vector, cell, stops, alive);
            } else {
                store(cell, behind);
            }
            for (int channel = 1; channel <= channels; ++channel) {
                store(cell + channel * LANES, load(cell + channel * LANES) + weight * layer.color[channel - 1]);
            }
            if (WEIGHED) weights += weight * load(counts + vector * LANES);
        }
    }
    return WEIGHED ? sum(weights) : 0.0f;
}

// Composites `layers`, front to back; CHANNELS and WEIGHED as above. slots: where the sums of weights go, by slot.
template <int CHANNELS, bool WEIGHED = false>
void composite(const std::vector<Layer>& layers, const TileFrame& tile, int channels, float* cells, int32_t* stops,
               const float* counts = nullptr, float* slots = nullptr) {
    if (CHANNELS >= 0) channels = CHANNELS;
    Alive alive;
    begin_tile(tile, channels, cells, stops, alive);
    alignas(64) float columns[TILE_WIDTH];
    number_columns(columns);
    Footprint f;
    const int count = static_cast<int>(layers.size());
    for (int index = 0; index < count && alive.count > 0; ++index) {
        if (index + AHEAD < count) prefetch(layers[index + AHEAD].splat);
        const Layer& layer = layers[index];
        find_footprint(*layer.splat, tile, f);
        const float weight =
            may_clamp(*layer.splat)
                ? add_layer<CHANNELS, true, WEIGHED>(layer, index, f, columns, channels, cells, stops, alive, counts)
                : add_layer<CHANNELS, false, WEIGHED>(layer, index, f, columns, channels, cells, stops, alive, counts);
        if (WEIGHED && layer.slot >= 0) slots[layer.slot] = weight;
    }
    for (int vector = 0; vector < TILE_VECTORS; ++vector) {
        for (int lane = 0; lane < LANES; ++lane) {
            float& t = cells[vector * cell_size(channels) + lane];
            t = std::fabs(t);
        }
    }
}

void composite_any(const std::vector<Layer>& layers, const TileFrame& tile, int channels, float* cells, int32_t* stops) {
    switch (channels) {
        case 0: return composite<0>(layers, tile, 0, cells, stops);
        case 1: return composite<1>(layers, tile, 1, cells, stops);
        case 3: return composite<3>(layers, tile, 3, cells, stops);
        case 4: return composite<4>(layers, tile, 4, cells, stops);
        default: return composite<-1>(layers, tile, channels, cells, stops);
    }
}

// A composited tile, or none (cells null): nothing was drawn there.
struct Composited {
    const float* cells;
    int channels;  // that the cells have: all, or 0

    float transmittance(int pixel) const {
        return cells == nullptr ? 1.0f : cells[pixel / LANES * cell_size(channels) + pixel % LANES];
    }
    // Over a background of `behind`. Where the cells have no colours it stands there undimmed.
    float color(int pixel, int channel, float behind) const {
        if (channels == 0) return behind;
        const float* const cell = cells + pixel / LANES * cell_size(channels) + pixel % LANES;
        return cell[(1 + channel) * LANES] + cell[0] * behind;
    }
};

void write_compact(const Frame& frame, int tile, Composited from, float* color, float* opacity) {
    const int64_t place = frame.compact_places[tile];
    if (place < 0) return;
    const TileFrame at = tile_frame(frame, tile);
    std::memset(opacity + place * TILE_PIXELS, 0, sizeof(float) * TILE_PIXELS);
    std::memset(color + place * frame.channels * TILE_PIXELS, 0, sizeof(float) * TILE_PIXELS * frame.channels);
    for (int row = 0; row < at.rows; ++row) {
        const int64_t start = static_cast<int64_t>(at.y + row) * frame.camera.width + at.x;
        for (int column = 0; column < at.columns; ++column) {
            const int pixel = row * TILE_WIDTH + column;
            opacity[place * TILE_PIXELS + pixel] = 1.0f - from.transmittance(pixel);
            const float* const behind = frame.background_at(start + column);
            for (int channel = 0; channel < frame.channels; ++channel) {
                color[(place * frame.channels + channel) * TILE_PIXELS + pixel] =
                    from.color(pixel, channel, behind == nullptr ? 0.0f : behind[channel]);
            }
        }
    }
}

// Rows of pixels of a tile without colours: the background.
void write_background(const Frame& frame, const TileFrame& at, float* color) {
    const int channels = frame.channels;
    const size_t bytes = sizeof(float) * channels * at.columns;
    const float* above = nullptr;
    for (int row = 0; row < at.rows; ++row) {
        const int64_t start = (static_cast<int64_t>(at.y + row) * frame.camera.width + at.x) * channels;
        float* const out = color + start;
        if (frame.background == nullptr) {
            std::memset(out, 0, bytes);
        } else if (frame.background_per_pixel) {
            std::memcpy(out, frame.background + start, bytes);
        } else if (above != nullptr) {
            std::memcpy(out, above, bytes);
        } else {
            for (int i = 0; i < channels * at.columns; ++i) out[i] = frame.background[i % channels];
        }
        above = out;
    }
}

template <int CHANNELS>
void write_image(const Frame& frame, int tile, Composited from, float* color, float* opacity) {
    const int channels = CHANNELS > 0 ? CHANNELS : frame.channels;
    const TileFrame at = tile_frame(frame, tile);
    if (from.channels == 0 && channels > 0) write_background(frame, at, color);
    for (int row = 0; row < at.rows; ++row) {
        const int64_t start = static_cast<int64_t>(at.y + row) * frame.camera.width + at.x;
        if (from.cells == nullptr) {
            std::memset(opacity + start, 0, sizeof(float) * at.columns);
        } else {
            for (int column = 0; column < at.columns; ++column) {
                opacity[start + column] = 1.0f - from.transmittance(row * TILE_WIDTH + column);
            }
        }
        if (from.channels == 0) continue;
        for (int first = 0; first < at.columns; first += LANES) {
            const float* const cell = from.cells + (row * VECTORS + first / LANES) * cell_size(channels);
            const int lanes = std::min(LANES, at.columns - first);
            float* const out = color + (start + first) * channels;
            const int step = frame.background_per_pixel ? channels : 0;
            const float* const behind = frame.background_at(start + first);
            for (int lane = 0; lane < lanes; ++lane) {
                for (int channel = 0; channel < channels; ++channel) {
                    float value = cell[(1 + channel) * LANES + lane];
                    if (behind != nullptr) value += cell[lane] * behind[lane * step + channel];
                    out[lane * channels + channel] = value;
                }
            }
        }
    }
}

void write_tile(const Frame& frame, int tile, Composited from, float* color, float* opacity) {
    if (frame.compact) return write_compact(frame, tile, from, color, opacity);
    if (frame.channels == 3) return write_image<3>(frame, tile, from, color, opacity);
    write_image<-1>(frame, tile, from, color, opacity);
}

}  // namespace

void blend(Frame& frame, float* color, float* opacity) {
    frame.transmittance.fit(static_cast<size_t>(frame.placed) * TILE_PIXELS);
    frame.stops.fit(static_cast<size_t>(frame.placed) * TILE_PIXELS);
    // First the tiles with work, then those that hold the background, or a frozen frame's image, alone.
    in_pieces(frame.threads, frame.placed, 1, [&](int64_t begin, int64_t end, int) {
        Scratch& scratch = this_threads_scratch();
        float* const cells = scratch.cells.fit(static_cast<size_t>(TILE_VECTORS) * cell_size(frame.channels));
        for (int64_t at = begin; at < end; ++at) {
            const int tile = frame.order[at];
            const int64_t start = static_cast<int64_t>(frame.places[tile]) * TILE_PIXELS;
            const int channels = frame.modes[tile] == COLOR ? frame.channels : 0;
            merged_list(frame, tile, scratch.layers);
            composite_any(scratch.layers, tile_frame(frame, tile), channels, cells, frame.stops.data() + start);
            for (int vector = 0; vector < TILE_VECTORS; ++vector) {
                store(frame.transmittance.data() + start + vector * LANES, load(cells + vector * cell_size(channels)));
            }
            write_tile(frame, tile, {cells, channels}, color, opacity);
        }
    });
    in_pieces(frame.threads, frame.tiles, 16, [&](int64_t begin, int64_t end, int) {
        Buffer<float>& cells = this_threads_scratch().cells;
        for (int tile = static_cast<int>(begin); tile < end; ++tile) {
            if (frame.places[tile] >= 0) continue;
            const Frame* const frozen = frame.frozen;
            if (frozen == nullptr || frame.modes[tile] == SKIP || frozen->places[tile] < 0) {
                write_tile(frame, tile, {nullptr, 0}, color, opacity);
                continue;
            }
            const int64_t size = static_cast<int64_t>(TILE_VECTORS) * cell_size(frozen->channels);
            const float* const baked = frozen->baked.data() + frozen->places[tile] * size;
            if (frame.modes[tile] == COLOR) {
                write_tile(frame, tile, {baked, frozen->channels}, color, opacity);
                continue;
            }
            float* const transmittance = cells.fit(TILE_PIXELS);
            for (int vector = 0; vector < TILE_VECTORS; ++vector) {
                store(transmittance + vector * LANES, load(baked + vector * cell_size(frozen->channels)));
            }
            write_tile(frame, tile, {transmittance, 0}, color, opacity);
        }
    });
}

void weigh(Frame& frame, const float* counts, float* weights) {
    float* const slots = frame.slots.fit(frame.tile_starts[frame.tiles]);
    std::fill(slots, slots + frame.tile_starts[frame.tiles], 0.0f);  // layers behind exhausted pixels are not reached
    in_pieces(frame.threads, frame.placed, 1, [&](int64_t begin, int64_t end, int) {
        Scratch& scratch = this_threads_scratch();
        float* const cells = scratch.cells.fit(static_cast<size_t>(TILE_VECTORS) * cell_size(0));
        alignas(64) int32_t stops[TILE_PIXELS];
        alignas(64) float here[TILE_PIXELS];
        for (int64_t number = begin; number < end; ++number) {
            const int tile = frame.order[number];
            const TileFrame at = tile_frame(frame, tile);
            for (int row = 0; row < at.rows; ++row) {
                const int64_t start = static_cast<int64_t>(at.y + row) * frame.camera.width + at.x;
                float* const out = here + row * TILE_WIDTH;
                std::fill(out, out + TILE_WIDTH, 1.0f);
                if (counts != nullptr) std::memcpy(out, counts + start, sizeof(float) * at.columns);
            }
            merged_list(frame, tile, scratch.layers);
            composite<0, true>(scratch.layers, at, 0, cells, stops, here, slots);
        }
    });
    constexpr int64_t GRAIN = 4096;
    in_pieces(frame.threads, frame.gaussians.count, GRAIN, [&](int64_t begin, int64_t end, int) {
        for (int64_t i = begin; i < end; ++i) {
            weights[i] = 0.0f;
            if (frame.keys[i] == NOT_DRAWN) continue;
            const int32_t rank = frame.ranks[i];
            for (int32_t slot = frame.slot_starts[rank]; slot < frame.slot_starts[rank + 1]; ++slot) weights[i] += slots[slot];
        }
    });
}

void bake(Frame& frame) {
    const int64_t size = static_cast<int64_t>(TILE_VECTORS) * cell_size(frame.channels);
    frame.baked.fit(frame.placed * size);
    in_pieces(frame.threads, frame.placed, 1, [&](int64_t begin, int64_t end, int) {
        Scratch& scratch = this_threads_scratch();
        alignas(64) int32_t stops[TILE_PIXELS];
        for (int64_t at = begin; at < end; ++at) {
            const int tile = frame.order[at];
            merged_list(frame, tile, scratch.layers);
            composite_any(scratch.layers, tile_frame(frame, tile), frame.channels,
                          frame.baked.data() + frame.places[tile] * size, stops);
        }
    });
}

}  // namespace splash
