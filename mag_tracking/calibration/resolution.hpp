// The steps of a sensor's readings, reading by reading; resolution.py says what they are.

#pragma once

#include <algorithm>
#include <cmath>

#include "sensor.hpp"

namespace mag_tracking {

// Values that differ by a smaller share than this differ by rounding only: single precision.
constexpr double SAME = 3e-7;
// Noise of a larger variance, in squared steps, carries a reading over several steps, and averaging
// works. A reading that toggles between two steps has a variance of 0.25 at most.
constexpr double DITHERED = 0.3;
// [T] An axis that scatters less has not changed at all.
constexpr double MIN_STD = 1e-11;
// [steps] An axis that rests on one value may rest on the next one a moment later.
constexpr double TOGGLE = 1.2;
// An axis whose steps are larger than its noise stays the same more often than this, for each
// change.
constexpr double REPEATS = 0.2;
// Readings that stay the same for longer count as several measurements, one in each such time.
constexpr int64_t MAX_REST_NS = 300'000'000;

// Update the steps of a sensor, and since when each axis rests on one value. `raw` (3) [T] is as
// the sensor measured it; NaN = missing axis.
inline void note_step(Sensor& s, int64_t stamp, const double* raw) {
    for (int a = 0; a < 3; ++a) {
        const double value = raw[a];
        if (std::isnan(value)) continue;
        const double change = std::abs(value - s.raw[a]);
        if (change <= SAME * std::abs(value) && stamp >= s.rest_since_ns[a]) {
            if (stamp - s.rest_since_ns[a] <= MAX_REST_NS) ++s.n_rest[a];
            continue;
        }
        // A comparison with NaN is false: the first reading changes nothing. Only a rest that has
        // ended counts: an axis that hangs rests for ever.
        if (change >= 0.0) {
            s.n_same[a] += s.n_rest[a] - 1;
            ++s.n_changed[a];
            s.step[a] = std::min(s.step[a], change);
        }
        s.raw[a] = value, s.rest_since_ns[a] = stamp, s.n_rest[a] = 1;
    }
}

// Step [T] of raw axis `a`; 0 where it is too fine to be seen: the smallest change is the step of an
// axis that repeats itself, and a field that moves with every reading has a smallest change, too.
inline double seen_step(const Sensor& s, int a) {
    return double(s.n_same[a]) >= REPEATS * double(s.n_changed[a]) ? s.step[a] : 0.0;
}

// Steps of the axes after the soft-iron correction, into `out` (3): 0 where they are too fine to be
// seen, infinite where the axis has never changed.
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

// For how many readings axis `a` rests, after the correction: the raw axes count by what their
// steps add.
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

// Whether a step [T] is larger than a noise of this variance [T^2], which may be NaN.
inline bool rests(double variance, double step) { return variance <= DITHERED * (step * step); }

// `steps` (3) [T] of all axes: one that is not known yet (infinite) is that of the others if those
// rest, too. An axis that has never changed is dead (NaN) where another one of the same sensor
// changes with every reading; it may rest where none has changed so far.
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

// Add what the steps of a sensor do to its noise: `noise` is read, `step_variance` and `noise_std`
// are written, and into `limits` (3) [T] how far the mean of a block may be off, `freeze_std`
// standard deviations.
inline void apply_steps(Sensor& s, double freeze_std, double* limits) {
    double steps[3], variance[3];
    for (int a = 0; a < 3; ++a) variance[a] = s.noise[a][a];
    corrected_steps(s, steps);
    constexpr double least = MIN_STD * MIN_STD;
    for (int a = 0; a < 3; ++a)
        // An axis without any noise rests, also where it has moved with a target since.
        if (steps[a] == 0.0 && variance[a] <= least)
            steps[a] = std::max(s.step[0], std::max(s.step[1], s.step[2]));
    complete_steps(variance, steps);
    for (int a = 0; a < 3; ++a) {
        const bool is_coarse = std::isfinite(steps[a]) && rests(variance[a], steps[a]);
        // Another axis is louder now. This one rests as before.
        if (!is_coarse && variance[a] <= least && s.step_variance[a] > 0.0) continue;
        s.step_variance[a] = is_coarse ? steps[a] * steps[a] / 12.0 : 0.0;
        s.noise_std[a] = std::sqrt(variance[a] + s.step_variance[a]);
        limits[a] = freeze_std * s.noise_std[a];
        if (is_coarse) limits[a] = std::max(limits[a], TOGGLE * steps[a]);
    }
}

}  // namespace mag_tracking
