// Function multiversioning for several generations of processors.

#pragma once

// Compiles one version of a function per generation; the loader selects the best supported version.
// With MAG_TRACKING_PROCESSOR, the generation of this computer, only that version and the one for
// all processors are compiled, which takes two thirds of the time. As the compiler inlines less in
// a larger file, the last digits of fits may differ from those with all versions.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__) && __GNUC__ >= 12
#if defined(MAG_TRACKING_PROCESSOR)
#define FOR_PROCESSORS __attribute__((target_clones("default", "arch=" MAG_TRACKING_PROCESSOR)))
#else
#define FOR_PROCESSORS __attribute__((target_clones("default", "arch=x86-64-v3", "arch=x86-64-v4")))
#endif
#else
#define FOR_PROCESSORS
#endif
