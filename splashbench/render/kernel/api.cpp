// The C interface: checks nothing (../arguments.py does), turns exceptions into a status, and keeps frames for later calls.

#include "api.h"

#include <pthread.h>

#include <algorithm>
#include <mutex>
#include <new>
#include <vector>

#include "frame.h"
#include "native/threads.h"

struct SplashFrame {
    splash::Frame frame;
};

namespace splash {
namespace {

// Frames given back, most recent last: their buffers fit the next call.
constexpr size_t MAX_SPARE = 4;
constexpr int64_t MAX_SPARE_BYTES = int64_t(1) << 28;  // of each; larger ones are freed
std::mutex spare_mutex;
std::vector<SplashFrame*>& spare_frames() {
    static std::vector<SplashFrame*>* const frames = [] {
        auto* const created = new std::vector<SplashFrame*>;
        created->reserve(MAX_SPARE);
        return created;
    }();
    return *frames;
}

// A child that was forked while another thread held the lock would wait for ever.
void guard_forks() {
    static std::once_flag once;
    std::call_once(once, [] {
        pthread_atfork([] { spare_mutex.lock(); }, [] { spare_mutex.unlock(); }, [] { spare_mutex.unlock(); });
    });
}

SplashFrame* take_frame() {
    guard_forks();
    {
        std::lock_guard<std::mutex> lock(spare_mutex);
        if (!spare_frames().empty()) {
            SplashFrame* const frame = spare_frames().back();
            spare_frames().pop_back();
            return frame;
        }
    }
    return new SplashFrame();
}

Camera camera_of(const SplashCamera& exact) {
    Camera camera;
    camera.exact = exact;
    for (int i = 0; i < 9; ++i) camera.rotation[i] = static_cast<float>(exact.world_to_camera[i / 3 * 4 + i % 3]);
    camera.fx = static_cast<float>(exact.fx);
    camera.fy = static_cast<float>(exact.fy);
    camera.width = exact.width;
    camera.height = exact.height;
    const double margin_x = JACOBIAN_MARGIN * exact.width, margin_y = JACOBIAN_MARGIN * exact.height;
    camera.min_tx = static_cast<float>((-exact.cx - margin_x) / exact.fx);
    camera.max_tx = static_cast<float>((exact.width - exact.cx + margin_x) / exact.fx);
    camera.min_ty = static_cast<float>((-exact.cy - margin_y) / exact.fy);
    camera.max_ty = static_cast<float>((exact.height - exact.cy + margin_y) / exact.fy);
    return camera;
}

// The summed area of tiles that are not skipped, and where these stand in the compact output.
void set_modes(Frame& frame, const uint8_t* modes) {
    frame.modes.fit(frame.tiles);
    frame.compact_places.fit(frame.tiles);
    int32_t place = 0;
    frame.skips = false;
    for (int tile = 0; tile < frame.tiles; ++tile) {
        frame.modes[tile] = modes == nullptr ? static_cast<uint8_t>(COLOR) : modes[tile];
        frame.compact_places[tile] = frame.modes[tile] == SKIP ? -1 : place++;
        frame.skips |= frame.modes[tile] == SKIP;
    }
    const int stride = frame.tile_columns + 1;
    int32_t* const above = frame.active_above.fit(static_cast<size_t>(frame.tile_rows + 1) * stride);
    std::fill(above, above + stride, 0);
    for (int row = 0; row < frame.tile_rows; ++row) {
        above[(row + 1) * stride] = 0;
        for (int column = 0; column < frame.tile_columns; ++column) {
            const int at = row * stride + column;
            above[at + stride + 1] = above[at + stride] + above[at + 1] - above[at] +
                                     (frame.modes[row * frame.tile_columns + column] != SKIP);
        }
    }
}

// Steps 1 to 3.
int prepare(Frame& frame, const SplashCamera& camera, const SplashGaussians& gaussians, bool depth, const uint8_t* modes,
            const Frame* frozen, int32_t threads) {
    if (gaussians.count >= INT32_MAX) return SPLASH_TOO_LARGE;
    frame.camera = camera_of(camera);
    frame.tile_columns = (camera.width + TILE_WIDTH - 1) / TILE_WIDTH;
    frame.tile_rows = (camera.height + TILE_HEIGHT - 1) / TILE_HEIGHT;
    frame.tiles = frame.tile_columns * frame.tile_rows;
    frame.threads = workers(threads);
    frame.gaussians = gaussians;
    frame.with_depth = depth;
    frame.channels = gaussians.channels + (depth ? 1 : 0);
    frame.table_colors = frame.channels != 3 || depth;
    frame.frozen = frozen;
    set_modes(frame, modes);
    if (!project(frame)) return SPLASH_NOT_FINITE;
    sort_by_depth(frame);
    bin(frame);
    return SPLASH_DONE;
}

}  // namespace
}  // namespace splash

extern "C" {

int splash_forward(const SplashCamera* camera, const SplashGaussians* gaussians, const SplashOutput* output,
                   const SplashFrame* frozen, int32_t threads, SplashFrame** result) {
    SplashFrame* handle = nullptr;
    try {
        handle = splash::take_frame();
        splash::Frame& frame = handle->frame;
        frame.compact = output->compact != 0;
        frame.background = output->background;
        frame.background_per_pixel = output->background_per_pixel != 0;
        const int status = splash::prepare(frame, *camera, *gaussians, output->depth != 0, output->modes,
                                           frozen == nullptr ? nullptr : &frozen->frame, threads);
        if (status != SPLASH_DONE) {
            splash_release(handle);
            return status;
        }
        splash::blend(frame, output->color, output->opacity);
        *result = handle;
        return SPLASH_DONE;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        delete handle;
        return SPLASH_OUT_OF_MEMORY;
    }
}

int splash_freeze(const SplashCamera* camera, const SplashGaussians* gaussians, int32_t depth, int32_t threads,
                  SplashFrame** result) {
    SplashFrame* handle = nullptr;
    try {
        handle = new SplashFrame();
        handle->frame.frozen_itself = true;
        const int status = splash::prepare(handle->frame, *camera, *gaussians, depth != 0, nullptr, nullptr, threads);
        if (status != SPLASH_DONE) {
            delete handle;
            return status;
        }
        splash::bake(handle->frame);
        *result = handle;
        return SPLASH_DONE;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        delete handle;
        return SPLASH_OUT_OF_MEMORY;
    }
}

int splash_backward(SplashFrame* handle, const float* grad_color, const float* grad_opacity, int32_t threads,
                    const SplashGradients* gradients) {
    try {
        handle->frame.threads = splash::workers(threads);
        splash::backward(handle->frame, grad_color, grad_opacity, *gradients);
        return SPLASH_DONE;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        return SPLASH_OUT_OF_MEMORY;
    }
}

int splash_weigh(const SplashCamera* camera, const SplashGaussians* gaussians, const float* counts, const SplashFrame* frozen,
                 int32_t threads, float* weights) {
    SplashFrame* handle = nullptr;
    try {
        handle = splash::take_frame();
        splash::Frame& frame = handle->frame;
        frame.compact = false;
        frame.background = nullptr;
        frame.background_per_pixel = false;
        SplashGaussians shapes = *gaussians;
        shapes.channels = 0;
        const splash::Frame* const other = frozen == nullptr ? nullptr : &frozen->frame;
        const int status = splash::prepare(frame, *camera, shapes, false, nullptr, other, threads);
        if (status == SPLASH_DONE) splash::weigh(frame, counts, weights);
        splash_release(handle);
        return status;
    } catch (...) {  // nothing but std::bad_alloc is thrown
        delete handle;
        return SPLASH_OUT_OF_MEMORY;
    }
}

void splash_release(SplashFrame* handle) {
    if (handle == nullptr) return;
    if (!handle->frame.frozen_itself && splash_frame_bytes(handle) <= splash::MAX_SPARE_BYTES) {
        std::lock_guard<std::mutex> lock(splash::spare_mutex);
        if (splash::spare_frames().size() < splash::MAX_SPARE) {
            splash::spare_frames().push_back(handle);
            return;
        }
    }
    delete handle;
}

void splash_trim(void) {
    std::lock_guard<std::mutex> lock(splash::spare_mutex);
    for (SplashFrame* handle : splash::spare_frames()) delete handle;
    splash::spare_frames().clear();
}

int64_t splash_frame_bytes(const SplashFrame* handle) {
    const splash::Frame& f = handle->frame;
    return static_cast<int64_t>(
        f.modes.bytes() + f.active_above.bytes() + f.projected.bytes() + f.keys.bytes() + f.ranks.bytes() + f.items.bytes() +
        f.other_items.bytes() + f.histograms.bytes() + f.splats.bytes() + f.channel_table.bytes() + f.slot_starts.bytes() +
        f.tile_starts.bytes() + f.entries.bytes() + f.tile_counts.bytes() + f.places.bytes() + f.order.bytes() +
        f.transmittance.bytes() + f.stops.bytes() + f.baked.bytes() + f.compact_places.bytes() + f.slots.bytes());
}

void splash_frame_counts(const SplashFrame* handle, int64_t counts[3]) {
    counts[0] = handle->frame.drawn;
    counts[1] = handle->frame.tile_starts[handle->frame.tiles];
    counts[2] = handle->frame.placed;
}

int splash_abi_version(void) { return SPLASH_ABI_VERSION; }

const char* splash_kernel(void) { return "render"; }

int splash_tile_width(void) { return splash::TILE_WIDTH; }

int splash_tile_height(void) { return splash::TILE_HEIGHT; }

void splash_constants(double values[6]) {
    values[0] = splash::NEAR_PLANE;
    values[1] = splash::BLUR_VARIANCE;
    values[2] = splash::MIN_ALPHA;
    values[3] = splash::MAX_ALPHA;
    values[4] = splash::MIN_TRANSMITTANCE;
    values[5] = splash::JACOBIAN_MARGIN;
}

}  // extern "C"
