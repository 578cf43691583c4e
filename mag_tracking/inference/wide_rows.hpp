// Covariances with rows padded to a multiple of eight, and the part that an update changes.

#pragma once

#include <algorithm>
#include <cstring>

#include "../arrays.hpp"

namespace mag_tracking {

// Minimum row length, in vectors of eight, at which updating half of the covariance is faster.
constexpr int HALVED_FROM = 10;

// Numbers of states. Rows of n_x states are padded by zeros to `wide` elements, a multiple of
// eight.
struct Sizes {
    int n_x, n_t, n_own, n_sensors, wide, n_eights;
    // Updates skip half of the covariance: in rows of sensor states, all before the diagonal block.
    bool is_halved;

    Sizes(int n_t_, int n_own_, int n_sensors_)
        : n_x(n_t_ + (n_own_ + 3) * n_sensors_), n_t(n_t_), n_own(n_own_), n_sensors(n_sensors_),
          wide((n_x + EIGHT - 1) / EIGHT * EIGHT), n_eights(wide / EIGHT),
          is_halved(n_eights >= HALVED_FROM) {}

    INLINE int n_seen() const { return n_t + n_own; }
    // First of the own states of sensor j.
    INLINE int own(int j) const { return n_t + n_own * j; }
    // State of column c of the derivative of sensor j.
    INLINE int seen(int j, int c) const { return c < n_t ? c : c + n_own * j; }
    INLINE int background(int j) const { return n_x - 3 * (n_sensors - j); }
    INLINE std::size_t square() const { return std::size_t(n_x) * wide; }
    // First vector of row i that an update changes.
    INLINE int first_eight(int i) const { return is_halved && i >= n_t ? i / EIGHT : 0; }
};

// Copies n rows of n elements between row lengths. Rows are too short for calls of memcpy.
INLINE void copy_rows(const double* from, int from_row, double* to, int to_row, int n) {
    for (int i = 0; i < n; ++i, from += from_row, to += to_row) {
        int k = 0;
        for (; k + EIGHT <= n; k += EIGHT) std::memcpy(to + k, from + k, sizeof(Eight));
        // Copy the remainder together with elements before it, as one vector of eight.
        if (k < n && n >= EIGHT)
            std::memcpy(to + n - EIGHT, from + n - EIGHT, sizeof(Eight));
        else
            for (; k < n; ++k) to[k] = from[k];
    }
}

INLINE void to_wide(const double* from, const Sizes& n, double* to) {
    copy_rows(from, n.n_x, to, n.wide, n.n_x);
    // The padding takes part in sums and may hold NaN from the previous hypothesis.
    for (int i = 0; i < n.n_x; ++i)
        for (int k = n.n_x; k < n.wide; ++k) to[i * n.wide + k] = 0.0;
}

INLINE void from_wide(const double* from, const Sizes& n, double* to) {
    copy_rows(from, n.wide, to, n.n_x, n.n_x);
}

// Fills the elements of rows [first, last) that an update has skipped, from the other triangle.
INLINE void complete_rows(double* P, const Sizes& n, int first, int last) {
    for (int k = 0; k < (last - 1) / EIGHT * EIGHT; ++k)
        for (int i = std::max(first, (k / EIGHT + 1) * EIGHT); i < last; ++i)
            P[i * n.wide + k] = P[k * n.wide + i];
}

#ifdef __clang__
#define SHUFFLED(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define SHUFFLED(a, b, ...) __builtin_shuffle(a, b, Indices{__VA_ARGS__})
#endif

// Transposes a block (8, 8) with a row length of `row`, by swapping elements between rows 1, 2 and
// 4 apart.
INLINE void transpose_block(const double* from, double* to, int row) {
    using Indices [[maybe_unused]] = long long __attribute__((vector_size(64)));
    Eight block[EIGHT];
    for (int k = 0; k < EIGHT; ++k) block[k] = *eights(from + k * row);
    for (int k = 0; k < EIGHT; k += 2) {
        const Eight a = block[k], b = block[k + 1];
        block[k] = SHUFFLED(a, b, 0, 8, 2, 10, 4, 12, 6, 14);
        block[k + 1] = SHUFFLED(a, b, 1, 9, 3, 11, 5, 13, 7, 15);
    }
    for (int k : {0, 1, 4, 5}) {
        const Eight a = block[k], b = block[k + 2];
        block[k] = SHUFFLED(a, b, 0, 1, 8, 9, 4, 5, 12, 13);
        block[k + 2] = SHUFFLED(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
    }
    for (int k = 0; k < 4; ++k) {
        const Eight a = block[k], b = block[k + 4];
        block[k] = SHUFFLED(a, b, 0, 1, 2, 3, 8, 9, 10, 11);
        block[k + 4] = SHUFFLED(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
    }
    for (int k = 0; k < EIGHT; ++k) *eights(to + k * row) = block[k];
}

#undef SHUFFLED

// Fills all elements that an update has skipped.
INLINE void complete(double* P, const Sizes& n) {
    if (!n.is_halved) return;
    for (int i = n.n_t / EIGHT * EIGHT; i < n.n_x; i += EIGHT) {
        if (i + EIGHT > n.n_x) {
            complete_rows(P, n, i, n.n_x);
            continue;
        }
        for (int k = 0; k < i; k += EIGHT)
            transpose_block(P + k * n.wide + i, P + i * n.wide + k, n.wide);
    }
}

}  // namespace mag_tracking
