// The pinhole projection of one Gaussian, linearised (EWA splatting), as both passes compute it.
//
// With the mean at (x, y, z) in the camera and J the Jacobian of the projection there,
//     J = [[fx/z, 0, -fx tx/z], [0, fy/z, -fy ty/z]],    tx = clamp(x/z), ty = clamp(y/z),
// the covariance B B^T becomes P P^T + blur, P = J R B. Its rows are p and q.
#pragma once

#include "frame.h"

namespace splash {

struct Vector {
    float x, y, z;
};

inline Vector operator+(Vector a, Vector b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vector operator*(float s, Vector a) { return {s * a.x, s * a.y, s * a.z}; }
inline float dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector cross(Vector a, Vector b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline Vector row(const float* matrix, int i) { return {matrix[3 * i], matrix[3 * i + 1], matrix[3 * i + 2]}; }

struct Linearised {
    float x, y, z, per_z;
    float tx, ty;
    Vector a, b;  // rows of J R
    Vector p, q;  // rows of J R B
};

struct Point {
    double x, y, z;
};

// The mean in the camera, in double: the difference to the camera's position may be small beside both.
inline Point in_camera(const Camera& camera, const float* mean) {
    const double* const m = camera.exact.world_to_camera;
    const double x = mean[0], y = mean[1], z = mean[2];
    return {m[0] * x + m[1] * y + m[2] * z + m[3], m[4] * x + m[5] * y + m[6] * z + m[7],
            m[8] * x + m[9] * y + m[10] * z + m[11]};
}

inline Linearised linearise(const Camera& camera, Point at, const float* factor) {
    Linearised l;
    l.x = static_cast<float>(at.x);
    l.y = static_cast<float>(at.y);
    l.z = static_cast<float>(at.z);
    l.per_z = 1.0f / l.z;
    l.tx = clamped(l.x * l.per_z, camera.min_tx, camera.max_tx);
    l.ty = clamped(l.y * l.per_z, camera.min_ty, camera.max_ty);
    const Vector right = row(camera.rotation, 0), down = row(camera.rotation, 1), forward = row(camera.rotation, 2);
    const float fx_z = camera.fx * l.per_z, fy_z = camera.fy * l.per_z;
    l.a = fx_z * right + (-fx_z * l.tx) * forward;
    l.b = fy_z * down + (-fy_z * l.ty) * forward;
    l.p = l.a.x * row(factor, 0) + l.a.y * row(factor, 1) + l.a.z * row(factor, 2);
    l.q = l.b.x * row(factor, 0) + l.b.y * row(factor, 1) + l.b.z * row(factor, 2);
    return l;
}

}  // namespace splash
