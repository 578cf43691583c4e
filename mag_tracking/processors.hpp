// Function multiversioning for several generations of processors.

#pragma once

// Compiles one version of a function per generation; the loader selects the best supported version.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12
#define FOR_PROCESSORS \
    __attribute__((target_clones("default", "arch=x86-64-v3", "arch=x86-64-v4")))
#else
#define FOR_PROCESSORS
#endif
