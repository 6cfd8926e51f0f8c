// Step 3: each tile's list of splats, front to back, and a slot per (splat, tile) for the gradients.
//
// A counting sort by tile. Each thread keeps a part of the depth order and counts of its own, so the lists are the same
// for any number of threads. The slots of a splat follow each other, so its gradients are summed without atomics.

#include <algorithm>

#include "frame.h"
#include "native/threads.h"
#include "tiles.h"

namespace splash {
namespace {

template <class Visit>
void for_tiles(const Frame& frame, const Splat& splat, Visit&& visit) {
    const TileRange range = tile_range(frame, splat);
    for (int row = range.top; row < range.bottom; ++row) {
        for (int column = range.left; column < range.right; ++column) {
            const int tile = row * frame.tile_columns + column;
            if (frame.modes[tile] != SKIP) visit(tile);
        }
    }
}

void fill_lists(Frame& frame) {
    const int parts = frame.threads, tiles = frame.tiles;
    int32_t* const counts = frame.tile_counts.fit(static_cast<size_t>(parts) * tiles);
    int32_t* const slots = frame.slot_starts.fit(frame.drawn + 1);
    int64_t part_slots[MAX_THREADS + 1] = {0};
    in_parts(parts, frame.drawn, [&](int64_t begin, int64_t end, int part) {
        int32_t* const mine = counts + static_cast<size_t>(part) * tiles;
        std::fill(mine, mine + tiles, 0);
        int64_t total = 0;
        for (int64_t k = begin; k < end; ++k) {
            slots[k] = static_cast<int32_t>(total);
            for_tiles(frame, frame.splats[k], [&](int tile) { ++mine[tile], ++total; });
        }
        part_slots[part + 1] = total;
    });
    for (int part = 0; part < parts; ++part) part_slots[part + 1] += part_slots[part];
    if (part_slots[parts] > INT32_MAX) throw std::bad_alloc();
    int32_t* const starts = frame.tile_starts.fit(tiles + 1);
    int32_t next = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        starts[tile] = next;
        for (int part = 0; part < parts; ++part) {
            int32_t& place = counts[static_cast<size_t>(part) * tiles + tile];
            const int32_t here = place;
            place = next;
            next += here;
        }
    }
    starts[tiles] = next;
    slots[frame.drawn] = next;
    frame.entries.fit(next);
    in_parts(parts, frame.drawn, [&](int64_t begin, int64_t end, int part) {
        int32_t* const mine = counts + static_cast<size_t>(part) * tiles;
        for (int64_t k = begin; k < end; ++k) {
            slots[k] += static_cast<int32_t>(part_slots[part]);
            int32_t slot = slots[k];
            for_tiles(frame, frame.splats[k], [&](int tile) {
                frame.entries[mine[tile]++] = {static_cast<int32_t>(k), slot++};
            });
        }
    });
}

// Tiles in which there is something to composite, the longest lists first, so that all threads end together.
void place_tiles(Frame& frame) {
    frame.places.fit(frame.tiles);
    frame.order.fit(frame.tiles);
    frame.placed = 0;
    for (int tile = 0; tile < frame.tiles; ++tile) {
        const bool work = frame.modes[tile] != SKIP && !frame.empty(tile);
        frame.places[tile] = work ? frame.placed : -1;
        if (work) frame.order[frame.placed++] = tile;
    }
    const auto length = [&](int tile) {
        const Frame* const frozen = frame.frozen;
        const int behind = frozen == nullptr ? 0 : frozen->tile_starts[tile + 1] - frozen->tile_starts[tile];
        return frame.tile_starts[tile + 1] - frame.tile_starts[tile] + behind;
    };
    std::sort(frame.order.data(), frame.order.data() + frame.placed, [&](int a, int b) {
        return length(a) != length(b) ? length(a) > length(b) : a < b;
    });
}

}  // namespace

void bin(Frame& frame) {
    fill_lists(frame);
    place_tiles(frame);
}

}  // namespace splash
