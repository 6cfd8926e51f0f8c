// Which tiles a splat reaches: those its bounding box meets. Closer tests gain nothing, since footprint.h leaves out the
// pixels beside the ellipse.
#pragma once

#include <algorithm>
#include <cmath>

#include "frame.h"

namespace splash {

// Rounding should not lose a pixel on the ellipse's edge; alpha is tested again at each pixel.
constexpr float SLACK = 1e-3f;

struct TileRange {
    int left, right, top, bottom;  // right and bottom excluded
};

// The tile along one axis that holds a pixel, the nearest one for pixels beyond the image.
inline int tile_index(float pixel, float size, int last) {
    // In this order NaN becomes 0.
    return static_cast<int>(std::min(std::max(0.0f, pixel / size), static_cast<float>(last)));
}

// The tiles that hold a pixel of the box at (x, y) px, that far from it to either side. Written without branches: whether a
// Gaussian is in the image is anyone's guess.
inline TileRange box_range(const Frame& frame, double center_x, double center_y, float half_width, float half_height) {
    const float x = static_cast<float>(center_x) - 0.5f, y = static_cast<float>(center_y) - 0.5f;
    const float left = x - half_width - SLACK, right = x + half_width + SLACK;
    const float top = y - half_height - SLACK, bottom = y + half_height + SLACK;
    const int inside = static_cast<int>(right >= 0.0f) & static_cast<int>(bottom >= 0.0f) &
                       static_cast<int>(left <= static_cast<float>(frame.camera.width - 1)) &
                       static_cast<int>(top <= static_cast<float>(frame.camera.height - 1));
    const int last_column = frame.tile_columns - 1, last_row = frame.tile_rows - 1;
    const int first_left = tile_index(left, TILE_WIDTH, last_column), first_top = tile_index(top, TILE_HEIGHT, last_row);
    return {first_left, inside ? tile_index(right, TILE_WIDTH, last_column) + 1 : first_left, first_top,
            inside ? tile_index(bottom, TILE_HEIGHT, last_row) + 1 : first_top};
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
