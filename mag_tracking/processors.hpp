// Functions that are compiled for several generations of processors.

#pragma once

// One function for each generation of processors; the loader takes the best that there is.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12
#define FOR_PROCESSORS \
    __attribute__((target_clones("default", "arch=x86-64-v3", "arch=x86-64-v4")))
#else
#define FOR_PROCESSORS
#endif
