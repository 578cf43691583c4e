// Function multiversioning for several generations of processors.

#pragma once

#include <stdexcept>

// Compiles one version of a function per generation; the loader selects the best supported version.
// With MAG_TRACKING_PROCESSOR, the generation of this computer, only that version is compiled: three
// versions take three times as long.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12
#if defined(MAG_TRACKING_PROCESSOR)
#define FOR_PROCESSORS __attribute__((target("arch=" MAG_TRACKING_PROCESSOR)))
#else
#define FOR_PROCESSORS __attribute__((target_clones("default", "arch=x86-64-v3", "arch=x86-64-v4")))
#endif
#else
#define FOR_PROCESSORS
#endif

namespace mag_tracking {

// Makes the import fail if the module was compiled for a newer processor than this computer has.
inline void check_processor() {
#if defined(MAG_TRACKING_PROCESSOR) && defined(__x86_64__) && !defined(__clang__) && __GNUC__ >= 12
    if (!__builtin_cpu_supports(MAG_TRACKING_PROCESSOR))
        throw std::runtime_error("mag_tracking was compiled for " MAG_TRACKING_PROCESSOR
                                 ", which this computer does not support: install it again here");
#endif
}

}  // namespace mag_tracking
