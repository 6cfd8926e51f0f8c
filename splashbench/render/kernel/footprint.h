// Which pixels of a tile a splat covers: per row, the vectors of columns within the ellipse alpha >= MIN_ALPHA.
//
// In the row at dy the exponent is peak - u^2 with peak = log2_opacity - fall dy^2 and u = root e, e the distance from the
// row's middle x + slope dy, so alpha reaches MIN_ALPHA where e^2 <= (peak - LOG2_MIN_ALPHA) / root^2.
#pragma once

#include <cmath>
#include <vector>

#include "frame.h"
#include "native/simd.h"
#include "tiles.h"

namespace splash {

constexpr int VECTORS = TILE_WIDTH / LANES;  // per row of a tile
constexpr int TILE_VECTORS = VECTORS * TILE_HEIGHT;

struct TileFrame {
    int x, y;           // of the first pixel
    int columns, rows;  // within the image
};

inline TileFrame tile_frame(const Frame& frame, int tile) {
    const int x = frame.tile_column(tile) * TILE_WIDTH, y = frame.tile_row(tile) * TILE_HEIGHT;
    const int columns = frame.camera.width - x, rows = frame.camera.height - y;
    return {x, y, columns < TILE_WIDTH ? columns : TILE_WIDTH, rows < TILE_HEIGHT ? rows : TILE_HEIGHT};
}

// Rows [top, bottom] of the tile; in each the vectors [first, last], numbered through the tile (none where last < first),
// the splat's peak, and `shift`: u = root column - shift, columns counted from the tile's first pixel centre.
struct Footprint {
    int top, bottom;
    alignas(64) float shift[TILE_HEIGHT + LANES];
    alignas(64) float peak[TILE_HEIGHT + LANES];
    alignas(64) int32_t first[TILE_HEIGHT + LANES];
    alignas(64) int32_t last[TILE_HEIGHT + LANES];
};

inline void find_footprint(const Splat& s, const TileFrame& tile, Footprint& f) {
    const float y = static_cast<float>(s.y - 0.5 - tile.y), x = static_cast<float>(s.x - 0.5 - tile.x);
    f.top = static_cast<int>(std::ceil(clamped(y - s.half_height - SLACK, 0.0f, TILE_HEIGHT)));
    f.bottom = static_cast<int>(std::floor(clamped(y + s.half_height + SLACK, -1.0f, tile.rows - 1)));
    const Floats offsets = ramp(), columns = all(static_cast<float>(tile.columns));
    const Ints numbers = __builtin_convertvector(offsets, Ints);
    for (int row = f.top & ~(LANES - 1); row <= f.bottom; row += LANES) {
        const Floats dy = offsets + (row - y);
        const Floats peak = s.log2_opacity - s.fall * dy * dy;
        const Floats middle = x + s.slope * dy;
        const Floats squared = max((peak - (LOG2_MIN_ALPHA - 2e-6f)) * (s.per_square * 1.00001f), all(0.0f));
        const Floats half = square_root(squared) + SLACK;
        const Floats left = min(max(middle - half, all(0.0f)), columns);
        const Floats right = min(max(middle + half, all(-1.0f)), columns - 1.0f);
        // The least integer not below `left`; what the constant falls short of 1 is within the slack.
        const Ints first = __builtin_convertvector(left + 0.999999f, Ints);
        const Ints last = __builtin_convertvector(right + 1.0f, Ints) - 1;
        const Ints none = first > last, start = (numbers + row) * VECTORS;
        store(f.shift + row, s.root * middle);
        store(f.peak + row, peak);
        store(f.first + row, start + first / LANES);
        store(f.last + row, ((start + last / LANES) & ~none) | none);
    }
}

inline void number_columns(float* columns) {
    for (int column = 0; column < TILE_WIDTH; ++column) columns[column] = static_cast<float>(column);
}

// Whether alpha can reach MAX_ALPHA at all, with room for rounding.
inline bool may_clamp(const Splat& s) { return s.log2_opacity > -0.0016f; }

// A splat in the tile's list together with the frozen ones, front to back.
struct Layer {
    const Splat* splat;
    const float* color;
    int32_t slot;  // -1 for a frozen splat
};

void merged_list(const Frame& frame, int tile, std::vector<Layer>& layers);

constexpr int AHEAD = 4;  // layers fetched in advance

// What a thread keeps between tiles.
struct Scratch {
    std::vector<Layer> layers;
    Buffer<float> cells;
};

inline Scratch& this_threads_scratch() {
    static thread_local Scratch scratch;
    return scratch;
}

}  // namespace splash
