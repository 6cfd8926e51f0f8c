// Which tiles a splat reaches: those its bounding box meets. Closer tests gain nothing, since footprint.h leaves out the
// pixels beside the ellipse.
#pragma once

#include <cmath>

#include "frame.h"

namespace splash {

// Rounding must not lose a pixel on the ellipse's edge; alpha is tested again at each pixel.
constexpr float SLACK = 1e-3f;

struct TileRange {
    int left, right, top, bottom;  // right and bottom excluded
};

inline int tile_index(float pixel, float size, int count) {
    const float tile = std::floor(pixel / size);
    return tile < 0.0f ? 0 : tile > static_cast<float>(count) ? count : static_cast<int>(tile);
}

// The tiles that hold a pixel of the box at (x, y) px, that far from it to either side.
inline TileRange box_range(const Frame& frame, double center_x, double center_y, float half_width, float half_height) {
    TileRange range = {0, 0, 0, 0};
    const float x = static_cast<float>(center_x) - 0.5f, y = static_cast<float>(center_y) - 0.5f;
    const float left = x - half_width - SLACK, right = x + half_width + SLACK;
    const float top = y - half_height - SLACK, bottom = y + half_height + SLACK;
    if (right < 0.0f || bottom < 0.0f || left > frame.camera.width - 1 || top > frame.camera.height - 1) return range;
    range.left = tile_index(left, TILE_WIDTH, frame.tile_columns - 1);
    range.right = tile_index(right, TILE_WIDTH, frame.tile_columns - 1) + 1;
    range.top = tile_index(top, TILE_HEIGHT, frame.tile_rows - 1);
    range.bottom = tile_index(bottom, TILE_HEIGHT, frame.tile_rows - 1) + 1;
    return range;
}

inline TileRange tile_range(const Frame& frame, const Splat& s) {
    return box_range(frame, s.x, s.y, s.half_width, s.half_height);
}

// Number of tiles in a range that are not skipped.
inline int tiles_active(const Frame& frame, const TileRange& r) {
    const int stride = frame.tile_columns + 1;
    const int32_t* const above = frame.active_above.data();
    return above[r.bottom * stride + r.right] - above[r.top * stride + r.right] - above[r.bottom * stride + r.left] +
           above[r.top * stride + r.left];
}

}  // namespace splash
