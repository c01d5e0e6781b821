// zlib streams (RFC 1950, 1951), for pictures and for pages.
#pragma once
#include <cstdint>

namespace nerfvol {

// The zlib stream `from` as exactly n bytes; false where it is damaged or holds more or fewer.
bool inflate(const uint8_t* from, int64_t n_from, uint8_t* to, int64_t n);

}  // namespace nerfvol
