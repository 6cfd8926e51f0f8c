// The numbers that fix what an image of Gaussians is (those of gsplat 1.5.3, classic mode), and the tile size.
// ../constants.py says what each is for; a test holds the two files against each other.
#pragma once

namespace splash {

constexpr float NEAR_PLANE = 0.01f;
constexpr float BLUR_VARIANCE = 0.3f;
constexpr float MIN_ALPHA = 1.0f / 255.0f;
constexpr float MAX_ALPHA = 0.999f;
constexpr float MIN_TRANSMITTANCE = 1e-4f;
constexpr float JACOBIAN_MARGIN = 0.15f;

constexpr float LOG2_MIN_ALPHA = -7.994353436858858f;

// Large tiles keep the lists short; the spans of footprint.h keep the pixels outside an ellipse cheap.
constexpr int TILE_WIDTH = 64;
constexpr int TILE_HEIGHT = 32;
constexpr int TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT;

constexpr int MAX_CHANNELS = 33;  // 32 of the caller's and depth

}  // namespace splash
