// A bad cable: bytes changed, lost and made up, by a seeded generator.
#pragma once
#include <stdint.h>

#include <string>

struct LineNoise {
  uint32_t corrupt_ppm = 0, drop_ppm = 0, insert_ppm = 0;
  uint64_t state = 1;

  uint32_t next() {  // xorshift64*
    state ^= state >> 12;
    state ^= state << 25;
    state ^= state >> 27;
    return static_cast<uint32_t>((state * 2685821657736338717ULL) >> 32);
  }
  bool chance(uint32_t ppm) { return ppm != 0 && next() % 1000000 < ppm; }

  std::string operator()(const char* data, size_t length) {
    std::string out;
    for (size_t i = 0; i < length; ++i) {
      if (chance(insert_ppm)) out.push_back(static_cast<char>(next() & 255));
      if (chance(drop_ppm)) continue;
      const char byte = chance(corrupt_ppm) ? static_cast<char>(data[i] ^ (1 + next() % 255)) : data[i];
      out.push_back(byte);
    }
    return out;
  }
};
