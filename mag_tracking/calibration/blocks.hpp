// Blocks of readings, and the background line that is fitted to them (blocks.py,
// background_level.py).

#pragma once

#include <cmath>

#include "sensor.hpp"

namespace mag_tracking {

// Minimum number of readings of a block, even of a slow sensor; fewer do not determine the noise.
constexpr int MIN_SAMPLES = 8;

// Subtract the background at `time` [s] from `field` (3) [T], into `out` (3).
//
// The drift is extrapolated for at most twice the interval that it was fitted to: a drift from
// three seconds of readings is not valid for twenty.
inline void subtract_background(const Sensor& s, double time, const double* field, double* out) {
    const double since = (s.horizon < time ? s.horizon : time) - s.centre;
    for (int a = 0; a < 3; ++a) out[a] = field[a] - s.mean[a] - since * s.slope[a];
}

// Integer part of a / b for `a` >= 0 and `b` > 0, correct even if the quotient is rounded up.
inline double whole_times(double a, double b) { return std::round((a - std::fmod(a, b)) / b); }

// Begin the next block if a reading at `time` [s] is the first after the current block. An earlier
// complete block (`is_full`) must have been evaluated before.
inline void begin_block_if_due(Sensor& s, double time) {
    if (std::isnan(s.end)) {
        s.end = time + s.length * (std::isnan(s.phase) ? 1.0 : 1.0 + s.phase);
        return;
    }
    if (!(time >= s.end && s.n[s.now] >= MIN_SAMPLES)) return;
    s.now = 1 - s.now, s.is_full = 1;
    s.n[s.now] = 0;
    if (std::isnan(s.phase))
        s.end = time + s.length;
    else
        // Otherwise, with timestamp jitter, the blocks of all sensors would eventually end at the
        // same reading and remain synchronised.
        s.end += (whole_times(time - s.end, s.length) + 1.0) * s.length;
}

// Add a reading, `field` (3) [T] at `time` [s], to the current block.
inline void collect(Sensor& s, double time, const double* field) {
    const auto k = s.now;
    double* origin = s.origin[k];
    if (s.n[k] == 0) {
        s.time[k] = 0.0;
        for (int a = 0; a < 3; ++a) {
            origin[a] = NAN;
            for (int b = 0; b < 3; ++b)
                s.count[k][a][b] = s.sum[k][a][b] = s.product[k][a][b] = 0.0;
        }
    }
    ++s.n[k];
    s.time[k] += time;
    for (int a = 0; a < 3; ++a) {
        if (std::isnan(field[a])) continue;
        if (std::isnan(origin[a])) origin[a] = field[a];
        const double d = field[a] - origin[a];
        for (int b = 0; b < 3; ++b) {
            if (std::isnan(field[b])) continue;
            // If the axis has not been reported before, this reading is its origin.
            const double e = std::isnan(origin[b]) ? 0.0 : field[b] - origin[b];
            s.count[k][a][b] += 1.0;
            s.sum[k][a][b] += d;
            s.product[k][a][b] += d * e;
        }
    }
}

// Mean (3) [T] and sum of squared deviations (3, 3) [T^2] of block `k`; a missing axis affects only
// its own elements.
inline void moments(const Sensor& s, int64_t k, double* mean, double* scatter) {
    const auto &count = s.count[k], &sum = s.sum[k];
    for (int a = 0; a < 3; ++a) mean[a] = count[a][a] > 0.0 ? sum[a][a] / count[a][a] : NAN;
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b)
            scatter[3 * a + b] = count[a][b] > 0.0
                                     ? s.product[k][a][b] - sum[a][b] * mean[b]
                                           - sum[b][a] * mean[a] + count[a][b] * mean[a] * mean[b]
                                     : 0.0;
    for (int a = 0; a < 3; ++a) mean[a] += s.origin[k][a];
}

// Pooled covariance within k blocks, from their sums of squared deviations `scatter` (k, 3, 3) and
// numbers of samples `n` (k, 3), into `out` (3, 3); NaN for an axis with too few samples. Returns
// false if all axes have too few.
inline bool pool(int64_t k, const double* scatter, const double* n, double* out) {
    double freedom[3] = {0.0, 0.0, 0.0}, sum[9] = {};
    for (int64_t i = 0; i < k; ++i) {
        for (int a = 0; a < 3; ++a) freedom[a] += n[3 * i + a] - (n[3 * i + a] != 0.0);
        for (int a = 0; a < 9; ++a) sum[a] += scatter[9 * i + a];
    }
    bool is_enough = false;
    for (double& f : freedom) {
        is_enough |= f > 3.0;
        if (!(f > 3.0)) f = NAN;
    }
    for (int a = 0; a < 9; ++a) out[a] = sum[a] / std::sqrt(freedom[a / 3] * freedom[a % 3]);
    return is_enough;
}

// Weighted least-squares line of one axis through the means `y` [T] of k blocks of `n` readings at
// `time` [s]: its value and slope at `centre`. `y` and `n` have a stride of three. NaN if no block
// has the axis.
inline void line(int64_t k, const double* time, const double* n, const double* y, double centre,
                 double& mean, double& slope) {
    double total = 0.0, mean_t = 0.0, mean_y = 0.0, spread = 0.0, along = 0.0;
    for (int64_t i = 0; i < k; ++i) {
        if (!(n[3 * i] > 0.0)) continue;
        total += n[3 * i];
        mean_t += n[3 * i] * time[i];
        mean_y += n[3 * i] * y[3 * i];
    }
    mean_t /= total, mean_y /= total;
    for (int64_t i = 0; i < k; ++i) {
        if (!(n[3 * i] > 0.0)) continue;
        const double d = time[i] - mean_t;
        spread += n[3 * i] * d * d;
        along += n[3 * i] * d * (y[3 * i] - mean_y);
    }
    slope = spread > 0.0 ? along / spread : 0.0;
    mean = mean_y + slope * (centre - mean_t);
}

}  // namespace mag_tracking
