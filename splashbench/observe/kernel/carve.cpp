// The distance of a grid's nodes to one view's silhouette cone (paper, "Observed geometry"; hull.py has the formula).
//
// Nodes are worked on in runs along z, quantity after quantity, so that everything but the look into the image becomes
// vector instructions. Projection and depths are in double precision, as a pixel off may be another layer; what is read
// from the image is in single precision.

#include "carve.h"

#include <algorithm>
#include <cmath>

#include "native/simd.h"
#include "native/threads.h"

namespace splash {
namespace {

// Nodes of a run.
constexpr int RUN = 64;
// In a line of the processor's cache.
constexpr int FLOATS_PER_LINE = 16;
static_assert(RUN % LANES == 0, "whole vectors");
// So many voxels in front of the camera's plane still count as in it, for rounding. What is in it or behind it has no pixel.
constexpr double IN_PLANE = 1e-9;

// What is not a number becomes 0: no place is outside the image, whatever the projection.
inline double inside(double place, double last) { return std::min(place > 0 ? place : 0.0, last); }

// Two neighbours of a row of an image.
typedef float Two __attribute__((vector_size(8)));
typedef float UnalignedTwo __attribute__((vector_size(8), aligned(4), may_alias));
inline Two two(const float* at) { return *reinterpret_cast<const UnalignedTwo*>(at); }

struct Run {
    double depth[RUN];                  // scene units
    float ahead[RUN];                   // the same; 0 in its plane and behind
    float across[RUN], down[RUN];       // share of the way to the next column and row
    float beyond[RUN];                  // pixels outside the window, squared
    int32_t place[RUN], middle[RUN];    // pixels: that above and left of the node's, and the nearest
    int32_t layer[RUN];
    float distance[RUN];                // pixels, then voxels
};

class View {
   public:
    explicit View(const SplashCarving& carving)
        : carving_(carving),
          right_(carving.width - 1.0),
          bottom_(carving.height - 1.0),
          per_voxel_(1.0 / (carving.focal * carving.voxel)) {
        for (int row = 0; row < 3; ++row) step_[row] = carving.projection[row][2] * carving.voxel;
    }

    // The nodes (i, j, first) to (i, j, first + count).
    void carve(int64_t i, int64_t j, int first, int count, Run& run) const {
        const int64_t at = (i * carving_.shape[1] + j) * carving_.shape[2] + first;
        for (int n = 0; n < count; n += FLOATS_PER_LINE) prefetch(carving_.phi + at + n);
        // Whole vectors, so that a node has the same bits wherever its run begins (a test holds compilers to it). What is
        // computed beyond `count` is not written.
        const int whole = (count + LANES - 1) / LANES * LANES;
        locate(i, j, first, whole, run);
        if (carving_.starts_count > 0) choose_layers(whole, run);
        look(whole, run, carving_.second == nullptr ? carving_.limit : -carving_.limit);
        if (carving_.second == nullptr) {
            take_largest(count, run, carving_.phi + at);
        } else {
            take_two_largest(count, run, carving_.phi + at, carving_.second + at);
        }
    }

   private:
    void locate(int64_t i, int64_t j, int first, int count, Run& run) const {
        const double x = carving_.origin[0] + static_cast<double>(i) * carving_.voxel;
        const double y = carving_.origin[1] + static_cast<double>(j) * carving_.voxel, z = carving_.origin[2];
        double start[3];
        for (int row = 0; row < 3; ++row) {
            const double* const p = carving_.projection[row];
            start[row] = p[0] * x + p[1] * y + p[2] * z + p[3];
        }
        // Pixel (row, column) is centred at (column + 0.5, row + 0.5).
        const double left = 0.5 + carving_.corner[0], top = 0.5 + carving_.corner[1];
        const double right = right_, bottom = bottom_, nearest = IN_PLANE * carving_.voxel;
        const int32_t last_column = carving_.width - 2, last_row = carving_.height - 2, width = carving_.width;
        for (int n = 0; n < count; ++n) {
            const double k = first + n;
            const double depth = start[2] + k * step_[2];
            const double nearness = 1.0 / (depth > nearest ? depth : nearest);
            const double u = (start[0] + k * step_[0]) * nearness - left;
            const double v = (start[1] + k * step_[1]) * nearness - top;
            const double inside_u = inside(u, right), inside_v = inside(v, bottom);
            const int32_t column = std::min(static_cast<int32_t>(inside_u), last_column);
            const int32_t row = std::min(static_cast<int32_t>(inside_v), last_row);
            run.depth[n] = depth;
            run.ahead[n] = depth > nearest ? static_cast<float>(depth) : 0.0f;
            run.beyond[n] =
                static_cast<float>((u - inside_u) * (u - inside_u) + (v - inside_v) * (v - inside_v));
            run.across[n] = static_cast<float>(inside_u - column);
            run.down[n] = static_cast<float>(inside_v - row);
            run.place[n] = row * width + column;
            run.middle[n] =
                static_cast<int32_t>(inside_v + 0.5) * width + static_cast<int32_t>(inside_u + 0.5);
        }
    }

    // The nearest layer that hides no more than is hidden at this depth, or no less: either keeps the sign.
    void choose_layers(int count, Run& run) const {
        const int32_t last = carving_.starts_count;
        for (int n = 0; n < count; ++n) run.layer[n] = 0;
        for (int32_t k = 0; k < last; ++k) {
            const double from = carving_.starts[k] + carving_.tolerance;
            for (int n = 0; n < count; ++n) run.layer[n] += run.depth[n] >= from ? 1 : 0;
        }
        float nearest[RUN];
        for (int n = 0; n < count; ++n) nearest[n] = carving_.nearest[run.middle[n]];
        const int32_t size = carving_.height * carving_.width;
        for (int n = 0; n < count; ++n) {
            // All three looked at: which of them holds changes from node to node, and branches would be guessed wrong.
            const int hidden = static_cast<int>(nearest[n] < run.depth[n] - carving_.tolerance) &
                               static_cast<int>(run.beyond[n] == 0.0f) & static_cast<int>(run.layer[n] < last);
            run.place[n] += (run.layer[n] + hidden) * size;
        }
    }

    // Distances in voxels; `behind` for points behind the camera.
    void look(int count, Run& run, float behind) const {
        for (int n = 0; n < count; ++n) {
            const float* const at = carving_.layers + run.place[n];
            const Two above = two(at), below = two(at + carving_.width);
            const Two between = above + run.down[n] * (below - above);
            run.distance[n] = between[0] + run.across[n] * (between[1] - between[0]);
        }
        const float limit = carving_.limit, per_voxel = static_cast<float>(per_voxel_);
        for (int n = 0; n < count; ++n) {
            const float pixels = run.distance[n] + std::sqrt(run.beyond[n]);
            const float voxels = pixels * (run.ahead[n] * per_voxel);
            const float clipped = std::min(std::max(voxels, -limit), limit);
            run.distance[n] = run.ahead[n] > 0 ? clipped : behind;
        }
    }

    static void take_largest(int count, const Run& run, float* phi) {
        for (int n = 0; n < count; ++n) phi[n] = run.distance[n] > phi[n] ? run.distance[n] : phi[n];
    }

    static void take_two_largest(int count, const Run& run, float* phi, float* second) {
        for (int n = 0; n < count; ++n) {
            const float value = run.distance[n];
            const float lesser = std::min(value, phi[n]);
            second[n] = lesser > second[n] ? lesser : second[n];
            phi[n] = value > phi[n] ? value : phi[n];
        }
    }

    const SplashCarving& carving_;
    double right_, bottom_, per_voxel_;
    double step_[3];  // of homogeneous pixel coordinates, between neighbours along z
};

}  // namespace

void carve(const SplashCarving& carving, int threads) {
    const View view(carving);
    const int ny = carving.shape[1], nz = carving.shape[2], block = carving.block;
    const int across = (ny + block - 1) / block, along = (nz + block - 1) / block;
    in_pieces(threads, carving.shape[0], block, [&](int64_t begin, int64_t end, int) {
        Run run;
        // The nodes (., ., first) to (., ., last) of all rows of blocks number (begin / block, b).
        const auto carve_rows = [&](int b, int first, int last) {
            for (int64_t i = begin; i < end; ++i) {
                for (int64_t j = int64_t{b} * block; j < std::min((b + 1) * block, ny); ++j) {
                    for (int k = first; k < last; k += RUN) view.carve(i, j, k, std::min(RUN, last - k), run);
                }
            }
        };
        for (int b = 0; b < across; ++b) {
            if (carving.blocks == nullptr) {
                carve_rows(b, 0, nz);
                continue;
            }
            const uint8_t* const wanted = carving.blocks + (begin / block * across + b) * along;
            for (int from = 0, to; from < along; from = to + 1) {
                for (to = from; to < along && wanted[to] != 0;) ++to;
                if (to > from) carve_rows(b, from * block, std::min(to * block, nz));
            }
        }
    });
}

}  // namespace splash
