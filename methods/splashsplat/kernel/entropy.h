// Whole numbers as a string of bytes: an adaptive binary range coder, with what was coded before as context. entropy.py
// says what for, storage/FORMAT.md how.
#pragma once

#include <cstdint>
#include <vector>

#include "api.h"

// Bytes that are written or read, and how far.
struct SplashCode {
    bool writes;
    uint32_t range = 0xFFFFFFFFu;
    uint64_t low = 0;                // writing: the lower end of the range, with a carry above 32 bits
    uint8_t first = 0;               // writing: the byte that a carry would change, with `waiting` - 1 of 0xFF after it
    int64_t waiting = 1;
    uint32_t word = 0;               // reading: how far into the range the code is
    const uint8_t* code = nullptr;   // reading
    int64_t size = 0, at = 0;        // reading: of code; and bytes read, those beyond its end included
    std::vector<uint8_t> out;        // writing
    std::vector<uint16_t> nodes, blocks;  // probabilities of signed distances, from frame to frame

    SplashCode(const uint8_t* code, int64_t size);
    bool overrun() const { return at > size; }
};

namespace splash {

// These three return false for what no writer gave.
bool code_table(SplashCode&, int32_t* table, int64_t rows, int32_t columns, int32_t near);
bool code_field(SplashCode&, int16_t* field, const int64_t shape[5]);
bool code_frame(SplashCode&, int8_t* now, const int8_t* before, uint8_t* changed, const int64_t shape[3], int32_t least,
                int32_t most);

// Of what was written, all bytes; of what is read, 0.
int64_t code_finished(SplashCode&);

}  // namespace splash
