// A step of the descent that fits a velocity to two signed distances (paper, Eq. velocity_fit).
//
// Values that are read together lie side by side, four floats each: a corner of a cell is one load.

#include "descend.h"

#include <algorithm>
#include <cmath>

#include "native/threads.h"

namespace splash {
namespace {

typedef float Four __attribute__((vector_size(16)));
typedef float UnalignedFour __attribute__((vector_size(16), aligned(4), may_alias));

// Fewer control cells than these are not worth a second thread.
constexpr int64_t CELLS_PER_PIECE = 256;
// Keeps ridges, where the central difference vanishes, from throwing the field about.
constexpr float RIDGE = 0.05f;

// Values [nx, ny, nz, 4] on the nodes of a grid, and how many floats are between neighbours along x and y.
struct Field {
    const float* values;
    int last[3];
    float top[3];
    int64_t along_x, along_y;

    Field(const float* values, const int32_t shape[3])
        : values(values), along_x(int64_t{4} * shape[1] * shape[2]), along_y(int64_t{4} * shape[2]) {
        for (int axis = 0; axis < 3; ++axis) {
            last[axis] = shape[axis] - 2;
            top[axis] = static_cast<float>(shape[axis] - 1);
        }
    }

    // Trilinear at a place in nodes; clamped to the grid outside it.
    Four at(float x, float y, float z) const {
        x = inside(x, top[0]);
        y = inside(y, top[1]);
        z = inside(z, top[2]);
        const int i = std::min(static_cast<int>(x), last[0]), j = std::min(static_cast<int>(y), last[1]);
        const int k = std::min(static_cast<int>(z), last[2]);
        const float a = x - static_cast<float>(i), b = y - static_cast<float>(j), c = z - static_cast<float>(k);
        const float* const corner = values + i * along_x + j * along_y + int64_t{4} * k;
        const Four near = between(corner, c), far = between(corner + along_y, c);
        const Four near_right = between(corner + along_x, c), far_right = between(corner + along_x + along_y, c);
        const Four left = near + b * (far - near), right = near_right + b * (far_right - near_right);
        return left + a * (right - left);
    }

   private:
    // What is not a number becomes 0.
    static float inside(float place, float top) { return std::min(place > 0 ? place : 0.0f, top); }

    static Four between(const float* at, float share) {
        const Four low = *reinterpret_cast<const UnalignedFour*>(at);
        const Four high = *reinterpret_cast<const UnalignedFour*>(at + 4);
        return low + share * (high - low);
    }
};

}  // namespace

void descend(const SplashDescent& descent, float* update, float* residual, int threads) {
    const Field before(descent.before, descent.shape), control(descent.control, descent.control_shape);
    float scale[3], shift[3];
    for (int axis = 0; axis < 3; ++axis) {
        scale[axis] = 1.0f / descent.factor[axis];
        shift[axis] = 0.5f * (descent.factor[axis] - 1.0f) * scale[axis];
    }
    in_pieces(threads, descent.cells, CELLS_PER_PIECE, [&](int64_t begin, int64_t end, int) {
        for (int64_t cell = begin; cell < end; ++cell) {
            Four sum = {0, 0, 0, 0};
            float error_sum = 0;
            for (int64_t n = descent.starts[cell]; n < descent.starts[cell + 1]; ++n) {
                const int32_t* const node = descent.nodes + 3 * n;
                const float x = static_cast<float>(node[0]), y = static_cast<float>(node[1]);
                const float z = static_cast<float>(node[2]);
                const Four u =
                    control.at(x * scale[0] - shift[0], y * scale[1] - shift[1], z * scale[2] - shift[2]);
                const Four there = before.at(x - u[0], y - u[1], z - u[2]);
                const int64_t at = (int64_t{node[0]} * descent.shape[1] + node[1]) * descent.shape[2] + node[2];
                const float error = descent.after[at] - there[0];
                const Four square = there * there;
                // phi[t](q - u) grows along -u: a positive error asks for a displacement against the gradient.
                sum += (-descent.step * error / (square[1] + square[2] + square[3] + RIDGE)) * there;
                error_sum += std::fabs(error);
            }
            for (int axis = 0; axis < 3; ++axis) update[3 * cell + axis] = sum[axis + 1];
            residual[cell] = error_sum;
        }
    });
}

}  // namespace splash
