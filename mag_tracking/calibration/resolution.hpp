// Steps of a sensor's readings, updated for each reading; see sensor_state.py.

#pragma once

#include <algorithm>
#include <cmath>

#include "sensor.hpp"

namespace mag_tracking {

// Maximum relative difference of two values that is due to rounding (single precision).
constexpr double MAX_ROUNDING = 3e-7;
// Minimum noise variance, in squared steps, at which readings cover several steps and averaging is
// effective. A reading that toggles between two steps has a variance of at most 0.25.
constexpr double DITHERED = 0.3;
// [T] Minimum standard deviation of the readings of an axis that is not constant.
constexpr double MIN_STD = 1e-11;
// [steps] Tolerance of an axis at rest, which may toggle between two adjacent values.
constexpr double TOGGLE_TOLERANCE = 1.2;
// Minimum number of repetitions per change of an axis whose steps are larger than its noise.
constexpr double MIN_REPEATS = 0.2;
// Maximum duration of a rest that counts as one measurement; a longer rest counts as several.
constexpr int64_t MAX_REST_NS = 300'000'000;

// Update the steps of a sensor, and the time of the latest change of each axis. `raw` (3) [T] is
// the raw reading; NaN for a missing axis.
inline void note_step(Sensor& s, int64_t stamp, const double* raw) {
    for (int a = 0; a < 3; ++a) {
        const double value = raw[a];
        if (std::isnan(value)) continue;
        const double change = std::abs(value - s.raw[a]);
        if (change <= MAX_ROUNDING * std::abs(value) && stamp >= s.rest_since_ns[a]) {
            if (stamp - s.rest_since_ns[a] <= MAX_REST_NS) ++s.n_rest[a];
            continue;
        }
        // A comparison with NaN is false: the first reading is no change. Only completed rests
        // count, since a stuck axis rests indefinitely.
        if (change >= 0.0) {
            s.n_same[a] += s.n_rest[a] - 1;
            ++s.n_changed[a];
            s.step[a] = std::min(s.step[a], change);
        }
        s.raw[a] = value, s.rest_since_ns[a] = stamp, s.n_rest[a] = 1;
    }
}

// Step [T] of raw axis `a`; 0 if it is too fine to be observed. The smallest change is the step
// only if the axis repeats values; a field that changes with every reading also has a smallest
// change.
inline double seen_step(const Sensor& s, int a) {
    return double(s.n_same[a]) >= MIN_REPEATS * double(s.n_changed[a]) ? s.step[a] : 0.0;
}

// Steps of the axes after the soft-iron correction, into `out` (3): 0 if they are too fine to be
// observed, infinite if the axis has never changed.
inline void corrected_steps(const Sensor& s, double* out) {
    for (int a = 0; a < 3; ++a) {
        if (!s.has_correction) {
            out[a] = seen_step(s, a);
            continue;
        }
        double total = 0.0;
        bool is_known = false;
        for (int b = 0; b < 3; ++b) {
            const double step = s.correction[a][b] * seen_step(s, b);
            if (s.correction[a][b] == 0.0 || !std::isfinite(step)) continue;
            total += step * step;
            is_known = true;
        }
        out[a] = is_known ? std::sqrt(total) : HUGE_VAL;
    }
}

// Number of readings for which corrected axis `a` has been constant: the mean over the raw axes,
// weighted by the variances due to their steps.
inline double rest_of(const Sensor& s, int a) {
    if (!s.has_correction) return double(s.n_rest[a]);
    double total = 0.0, weighted = 0.0;
    for (int b = 0; b < 3; ++b) {
        if (!std::isfinite(s.step[b])) continue;
        const double step = s.correction[a][b] * s.step[b];
        total += step * step;
        weighted += step * step * double(s.n_rest[b]);
    }
    return total > 0.0 ? weighted / total : 1.0;
}

// Whether an axis with this step [T] and noise variance [T^2], possibly NaN, repeats values.
inline bool rests(double variance, double step) { return variance <= DITHERED * (step * step); }

// Complete the `steps` (3) [T]: an unknown (infinite) step is copied from the other axes if these
// are at rest. An axis that has never changed is dead (NaN) if another axis of the same sensor
// changes with every reading. If no axis has changed, it may be at rest.
inline void complete_steps(const double* variance, double* steps) {
    double largest = 0.0;
    bool is_known = false;
    for (int a = 0; a < 3; ++a) {
        if (!std::isfinite(steps[a]) || std::isnan(variance[a])) continue;
        is_known = true;
        if (rests(variance[a], steps[a])) largest = std::max(largest, steps[a]);
    }
    for (int a = 0; a < 3; ++a)
        if (is_known && std::isinf(steps[a]) && !std::isnan(variance[a]))
            steps[a] = largest > 0.0 ? largest : NAN;
}

// Add the variance due to the steps of a sensor to its noise: reads `noise`, writes `step_variance`
// and `noise_std`, and writes the maximum difference between the mean of a block and the
// background, `freeze_std` standard deviations, to `limits` (3) [T].
inline void apply_steps(Sensor& s, double freeze_std, double* limits) {
    double steps[3], variance[3];
    for (int a = 0; a < 3; ++a) variance[a] = s.noise[a][a];
    corrected_steps(s, steps);
    constexpr double least = MIN_STD * MIN_STD;
    for (int a = 0; a < 3; ++a)
        // An axis without noise is at rest, even if a target has changed it since.
        if (steps[a] == 0.0 && variance[a] <= least)
            steps[a] = std::max(s.step[0], std::max(s.step[1], s.step[2]));
    complete_steps(variance, steps);
    for (int a = 0; a < 3; ++a) {
        const bool is_coarse = std::isfinite(steps[a]) && rests(variance[a], steps[a]);
        // Only another axis has become noisier; this one is still at rest.
        if (!is_coarse && variance[a] <= least && s.step_variance[a] > 0.0) continue;
        s.step_variance[a] = is_coarse ? steps[a] * steps[a] / 12.0 : 0.0;
        s.noise_std[a] = std::sqrt(variance[a] + s.step_variance[a]);
        limits[a] = freeze_std * s.noise_std[a];
        if (is_coarse) limits[a] = std::max(limits[a], TOGGLE_TOLERANCE * steps[a]);
    }
}

}  // namespace mag_tracking
