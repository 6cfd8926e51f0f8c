// What one camera's rendering is made of, step by step, and what the backward pass needs of it.
#pragma once

#include <cstdint>

#include "api.h"
#include "constants.h"
#include "native/buffer.h"

namespace splash {

// What a tile is rendered to: nothing, opacity alone, or colour and opacity.
enum Mode : uint8_t { SKIP = 0, OPACITY = 1, COLOR = 2 };

// One Gaussian in the image. At the offset (dx, dy) from its centre
//     log2 alpha = log2_opacity - fall dy^2 - (root (dx - slope dy))^2,
// the quadratic form of the inverse covariance with its square completed: a difference of large numbers, where a needle
// lies askew, is then taken between coordinates and not between their squares.
struct alignas(64) Splat {
    double x, y;                    // centre, px; a float leaves 13 bits for parts of a pixel in a wide image's last columns
    float root, slope, fall;        // 1/px, px per row, 1/px^2
    float log2_opacity;
    float per_square;               // 1 / root^2
    float half_width, half_height;  // the ellipse alpha = MIN_ALPHA reaches this far from the centre, px
    float depth;                    // along the optical axis, scene units
    float color[3];
};
static_assert(sizeof(Splat) == 64, "one cache line each");

struct Camera {
    SplashCamera exact;
    float rotation[9];  // world to camera
    float fx, fy;
    int width, height;
    // x/z and y/z at which the projection is linearised are clamped to these.
    float min_tx, max_tx, min_ty, max_ty;
};

// A splat in a tile's list, and where its gradients there go.
struct Entry {
    int32_t splat, slot;
};

struct SortItem {
    uint32_t key;
    int32_t id;
};

// Moments of a splat's gradient in one tile, before its channels' gradients; see backward.cpp.
constexpr int MOMENTS = 6;

// Floats of a slot: the moments and the channels, in whole vectors of four.
inline int slot_size(int channels) { return (MOMENTS + channels + 3) / 4 * 4; }

struct Frame {
    Camera camera;
    int tile_columns, tile_rows, tiles;
    int threads;
    bool frozen_itself = false;  // made by splash_freeze: not kept for later calls

    // The caller's, alive until the frame is released.
    SplashGaussians gaussians;
    int channels;       // of the output: the caller's, and depth where wanted
    bool with_depth;
    bool table_colors;  // colours stand in channel_table, not in the splats
    const Frame* frozen;

    Buffer<uint8_t> modes;         // [tiles]
    bool skips;                    // whether any of them is SKIP
    Buffer<int32_t> active_above;  // [(tile_rows + 1) * (tile_columns + 1)], tiles not skipped above and left of a corner

    // project.cpp, sort.cpp
    int64_t drawn;
    Buffer<Splat> projected;      // [count], by id
    Buffer<uint32_t> keys;        // [count], NOT_DRAWN where left out
    Buffer<int32_t> ranks;        // [count], id to rank in depth; nothing where left out
    Buffer<SortItem> items, other_items;
    Buffer<int64_t> histograms;
    Buffer<Splat> splats;         // [drawn], by depth
    Buffer<float> channel_table;  // [drawn, channels], by depth

    // bin.cpp
    Buffer<int32_t> slot_starts;  // [drawn + 1]
    Buffer<int32_t> tile_starts;  // [tiles + 1]
    Buffer<Entry> entries;
    Buffer<int32_t> tile_counts;
    Buffer<int32_t> places;       // [tiles], place of a tile in the buffers below, -1 for none
    Buffer<int32_t> order;        // the tiles with a place, most work first
    int placed;

    // blend.cpp, per placed tile
    Buffer<float> transmittance;  // [placed, TILE_PIXELS]
    Buffer<int32_t> stops;        // [placed, TILE_PIXELS], index in the tile's list at which a pixel was exhausted
    Buffer<float> baked;          // a frozen frame's tiles, in the layout of blend.cpp
    bool compact;
    Buffer<int32_t> compact_places;  // [tiles], place in the compact output, -1 for none
    const float* background;
    bool background_per_pixel;

    // backward.cpp: [entries, slot_size(channels)]; `weigh`: [entries]
    Buffer<float> slots;

    int tile_row(int tile) const { return tile / tile_columns; }
    int tile_column(int tile) const { return tile % tile_columns; }
    // The background's channels at a pixel of the image, null for black.
    const float* background_at(int64_t pixel) const {
        return background == nullptr ? nullptr : background + (background_per_pixel ? pixel * channels : 0);
    }
    bool empty(int tile) const { return tile_starts[tile] == tile_starts[tile + 1]; }
};

inline float clamped(float value, float low, float high) { return value < low ? low : value > high ? high : value; }

constexpr uint32_t NOT_DRAWN = 0xffffffffu;

// The steps, in the order in which they run.
bool project(Frame& frame);  // false where an input is not finite
void sort_by_depth(Frame& frame);
void bin(Frame& frame);
void blend(Frame& frame, float* color, float* opacity);
void weigh(Frame& frame, const float* counts, float* weights);
void bake(Frame& frame);
void backward(Frame& frame, const float* grad_color, const float* grad_opacity, const SplashGradients& gradients);

}  // namespace splash
