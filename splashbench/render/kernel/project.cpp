// Step 1: Gaussians in the scene to splats in the image.
//
// The covariance [[xx, xy], [xy, yy]] = P P^T + blur I has the inverse whose quadratic form, square completed, is
//     (yy / det) (dx - slope dy)^2 + dy^2 / yy,    slope = xy / yy,
// and det = |p x q|^2 + blur (|p|^2 + |q|^2) + blur^2, free of cancellation.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>

#include "native/elementary.h"
#include "native/threads.h"
#include "projection.h"
#include "tiles.h"

namespace splash {
namespace {

constexpr int64_t BLOCK = 2048;
// Beyond these sizes float32 has no digits left for the quadratic form.
constexpr float LARGEST = 1e12f;

bool all_finite(const float* values, int64_t count) {
    const uint32_t exponent = 0x7f800000u;
    uint32_t bad = 0;
    for (int64_t i = 0; i < count; ++i) {
        uint32_t bits;
        std::memcpy(&bits, values + i, sizeof bits);
        bad |= (bits & exponent) == exponent;
    }
    return bad == 0;
}

// How far from its centre a Gaussian of opacity 1 or less can be seen, px, at the most: |p|^2 <= |a|^2 |B|^2 (Frobenius).
float farthest_reach(const Camera& camera, float per_z, const float* factor) {
    float squares = 0.0f;
    for (int i = 0; i < 9; ++i) squares += factor[i] * factor[i];
    const float tx = std::max(-camera.min_tx, camera.max_tx), ty = std::max(-camera.min_ty, camera.max_ty);
    const float f = std::max(camera.fx, camera.fy) * per_z, t = std::max(tx, ty);
    return std::sqrt(-2.0f * LN_2 * LOG2_MIN_ALPHA * (f * f * (1.0f + t * t) * squares + BLUR_VARIANCE));
}

// Fills `splat` and says whether the Gaussian is drawn at all.
bool project_one(const Frame& frame, int64_t i, Splat& splat) {
    const Camera& camera = frame.camera;
    const SplashGaussians& g = frame.gaussians;
    const float opacity = g.opacities[i];
    if (!(opacity >= MIN_ALPHA)) return false;
    const Point at = in_camera(camera, g.means + 3 * i);
    if (!(static_cast<float>(at.z) >= NEAR_PLANE)) return false;
    const double per_z = 1.0 / at.z;
    splat.x = camera.exact.fx * at.x * per_z + camera.exact.cx;
    splat.y = camera.exact.fy * at.y * per_z + camera.exact.cy;
    if (!(std::fabs(splat.x) < LARGEST && std::fabs(splat.y) < LARGEST)) return false;
    if (frame.skips && opacity <= 1.0f) {
        const float reach = farthest_reach(camera, static_cast<float>(per_z), g.factors + 9 * i);
        if (reach < LARGEST && tiles_active(frame, box_range(frame, splat.x, splat.y, reach, reach)) == 0) return false;
    }
    const Linearised l = linearise(camera, at, g.factors + 9 * i);
    const float pp = dot(l.p, l.p), pq = dot(l.p, l.q), qq = dot(l.q, l.q);
    if (!(pp < LARGEST && qq < LARGEST)) return false;
    const float xx = pp + BLUR_VARIANCE, yy = qq + BLUR_VARIANCE;
    const Vector normal = cross(l.p, l.q);
    const float determinant = dot(normal, normal) + BLUR_VARIANCE * (pp + qq) + BLUR_VARIANCE * BLUR_VARIANCE;
    splat.log2_opacity = std::log2(opacity);
    // On the ellipse's edge d^T inverse(covariance) d = reach.
    const float reach = 2.0f * LN_2 * std::max(0.0f, splat.log2_opacity - LOG2_MIN_ALPHA);
    splat.half_width = std::sqrt(reach * xx);
    splat.half_height = std::sqrt(reach * yy);
    if (tiles_active(frame, tile_range(frame, splat)) == 0) return false;
    const float square = 0.5f * LOG2_E * yy / determinant;
    splat.root = std::sqrt(square);
    splat.per_square = 1.0f / square;
    splat.slope = pq / yy;
    splat.fall = 0.5f * LOG2_E / yy;
    splat.depth = l.z;
    if (frame.table_colors) {
        splat.color[0] = splat.color[1] = splat.color[2] = 0.0f;
    } else {
        for (int channel = 0; channel < 3; ++channel) splat.color[channel] = g.colors[3 * i + channel];
    }
    return true;
}

}  // namespace

bool project(Frame& frame) {
    const SplashGaussians& g = frame.gaussians;
    frame.projected.fit(g.count);
    frame.keys.fit(g.count);
    std::atomic<bool> finite(true);
    in_pieces(frame.threads, g.count, BLOCK, [&](int64_t begin, int64_t end, int) {
        const int64_t n = end - begin;
        if (!all_finite(g.means + 3 * begin, 3 * n) || !all_finite(g.factors + 9 * begin, 9 * n) ||
            !all_finite(g.opacities + begin, n) ||
            (g.channels > 0 && !all_finite(g.colors + g.channels * begin, g.channels * n))) {
            finite.store(false, std::memory_order_relaxed);
            return;
        }
        for (int64_t i = begin; i < end; ++i) {
            Splat& splat = frame.projected[i];
            uint32_t key = NOT_DRAWN;
            // The bits of positive floats are in the order of the floats.
            if (project_one(frame, i, splat)) std::memcpy(&key, &splat.depth, sizeof key);
            frame.keys[i] = key;
        }
    });
    return finite.load();
}

}  // namespace splash
