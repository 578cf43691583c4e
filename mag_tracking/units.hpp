// Time constants, as in units.py.

#pragma once

#include <cstdint>
#include <limits>

namespace mag_tracking {

using std::int64_t;

// Timestamp of an event that has not happened [ns].
constexpr int64_t NEVER = std::numeric_limits<int64_t>::min();

}  // namespace mag_tracking
