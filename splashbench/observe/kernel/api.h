// The C interface of carving's kernel, which carving.py declares to Python. Arrays are C-contiguous.
#pragma once

#include <stdint.h>

#include "native/abi.h"

#ifdef __cplusplus
extern "C" {
#endif

// Raised with every change to what follows; the loader refuses another version.
#define SPLASH_ABI_VERSION 1

// One view, and the grid that it carves. Lengths without a unit are in scene units.
typedef struct SplashCarving {
    int32_t shape[3];           // nodes along x, y and z
    float* phi;                 // [nx, ny, nz] voxels
    float* second;              // likewise; null: the second largest values are not wanted
    int32_t block;              // nodes along the edge of a block
    const uint8_t* blocks;      // one for each block of the grid: 1 where its nodes are looked at; null: all are
    double origin[3], voxel;    // of node (0, 0, 0); between neighbours
    double projection[3][4];    // scene to pixels
    double focal;               // one pixel at depth z spans z / focal
    int32_t height, width;      // of the image window, at least 2 each
    double corner[2];           // its top-left pixel (x, y)
    int32_t starts_count;       // K
    const double* starts;       // [K] depths from which the layers after the first count, rising
    const float* layers;        // [K + 1, height, width] pixels
    const float* nearest;       // [height, width], depth of the occluder; null where K is 0
    double tolerance;           // what is farther behind the occluder than this is hidden
    float limit;                // voxels
} SplashCarving;

// phi = max(phi, distance of each node to the view's silhouette cone), in place; nodes behind the camera are `limit` outside.
// With `second` phi has the largest and `second` the second largest of all views so far, and nodes behind the camera count
// as -limit, which says nothing.
SPLASH_API void splash_carve(const SplashCarving*, int32_t threads);

#ifdef __cplusplus
}
#endif
