// Covariances in rows of whole vectors of eight, and which part of them an update has to touch.

#pragma once

#include <algorithm>
#include <cstring>

#include "../arrays.hpp"

namespace mag_tracking {

// Below this many vectors of eight a row, to complete rows takes longer than to update all of them.
constexpr int HALVED_FROM = 10;

// How many states there are. Rows of a state's length are stored with `wide` numbers, the last of
// which are zero, so that they are whole vectors of eight.
struct Sizes {
    int n_x, n_t, n_own, n_sensors, wide, n_eights;
    // An update keeps up half of the covariance: all of the target's rows, the others from their
    // own block on.
    bool is_halved;

    Sizes(int n_t_, int n_own_, int n_sensors_)
        : n_x(n_t_ + (n_own_ + 3) * n_sensors_), n_t(n_t_), n_own(n_own_), n_sensors(n_sensors_),
          wide((n_x + EIGHT - 1) / EIGHT * EIGHT), n_eights(wide / EIGHT),
          is_halved(n_eights >= HALVED_FROM) {}

    INLINE int n_seen() const { return n_t + n_own; }
    // First of the states of sensor j that only it sees.
    INLINE int own(int j) const { return n_t + n_own * j; }
    // State that belongs to column c of the derivative of sensor j.
    INLINE int seen(int j, int c) const { return c < n_t ? c : c + n_own * j; }
    INLINE int background(int j) const { return n_x - 3 * (n_sensors - j); }
    INLINE std::size_t square() const { return std::size_t(n_x) * wide; }
    // Of row i the vector of eight from which an update keeps it up.
    INLINE int first_eight(int i) const { return is_halved && i >= n_t ? i / EIGHT : 0; }
};

// A covariance (n_x, n_x) of others into one of rows that are `wide`, and back. Rows are too short
// for a call of memcpy.
INLINE void copy_rows(const double* from, int from_row, double* to, int to_row, int n) {
    for (int i = 0; i < n; ++i, from += from_row, to += to_row) {
        int k = 0;
        for (; k + EIGHT <= n; k += EIGHT) std::memcpy(to + k, from + k, sizeof(Eight));
        // The rest, once more with what is before it.
        if (k < n && n >= EIGHT)
            std::memcpy(to + n - EIGHT, from + n - EIGHT, sizeof(Eight));
        else
            for (; k < n; ++k) to[k] = from[k];
    }
}

INLINE void to_wide(const double* from, const Sizes& n, double* to) {
    copy_rows(from, n.n_x, to, n.wide, n.n_x);
    // What is beyond the states takes part in sums: NaN that a hypothesis before left is not zero.
    for (int i = 0; i < n.n_x; ++i)
        for (int k = n.n_x; k < n.wide; ++k) to[i * n.wide + k] = 0.0;
}

INLINE void from_wide(const double* from, const Sizes& n, double* to) {
    copy_rows(from, n.wide, to, n.n_x, n.n_x);
}

// The numbers of rows [first, last) of a covariance that an update has left behind, from its columns.
INLINE void complete_rows(double* P, const Sizes& n, int first, int last) {
    for (int k = 0; k < (last - 1) / EIGHT * EIGHT; ++k)
        for (int i = std::max(first, (k / EIGHT + 1) * EIGHT); i < last; ++i)
            P[i * n.wide + k] = P[k * n.wide + i];
}

// Rows `from` (8, 8) as columns `to` (8, 8): pairs are exchanged between rows 1, 2 and 4 apart.
INLINE void transpose_block(const double* from, double* to, int row) {
    using Indices = long long __attribute__((vector_size(64)));
    constexpr Indices LOW[3] = {{0, 8, 2, 10, 4, 12, 6, 14}, {0, 1, 8, 9, 4, 5, 12, 13},
                                {0, 1, 2, 3, 8, 9, 10, 11}};
    constexpr Indices HIGH[3] = {{1, 9, 3, 11, 5, 13, 7, 15}, {2, 3, 10, 11, 6, 7, 14, 15},
                                 {4, 5, 6, 7, 12, 13, 14, 15}};
    Eight block[EIGHT];
    for (int k = 0; k < EIGHT; ++k) block[k] = *eights(from + k * row);
    for (int step = 0; step < 3; ++step)
        for (int k = 0; k < EIGHT; ++k) {
            const int other = k | 1 << step;
            if (other == k) continue;
            const Eight one = block[k], two = block[other];
            block[k] = __builtin_shuffle(one, two, LOW[step]);
            block[other] = __builtin_shuffle(one, two, HIGH[step]);
        }
    for (int k = 0; k < EIGHT; ++k) *eights(to + k * row) = block[k];
}

// All that an update has left behind.
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
