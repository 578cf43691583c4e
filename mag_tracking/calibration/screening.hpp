// Rejection of faulty readings of one sensor: spikes and stuck sensors.
//
// Only a suspect reading is held until the next readings permit a decision; other readings pass
// immediately.

#pragma once

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "sensor.hpp"

namespace mag_tracking {

// Approximate number of readings over which the typical fraction of repetitions is determined.
constexpr double MEMORY = 20'000.0;
// Minimum number of changes of a sensor; with fewer changes, its steps may be so coarse that long
// repetitions are normal.
constexpr double MIN_CHANGES = 50.0;
// Log-probability below which a run of equal readings is a fault.
const double MIN_LOG_PROBABILITY = std::log(1e-9);
constexpr int MIN_RUN = 4;
// Fraction of repeated readings above which the steps of a sensor are coarse: at rest, it may
// repeat a reading indefinitely. With a noise of one step or more on three axes, the fraction is
// lower.
constexpr double COARSE_FRACTION = 0.05;
// Minimum ratio of a spike to the largest recent difference; larger if the rate is low.
constexpr double MIN_RATIO = 8.0;
// [1/s] Maximum speed of a target relative to its distance: 30 m/s at one metre.
constexpr double MAX_RATE = 30.0;
// Mean of the largest of `N_RECENT` differences between readings of white noise, in its standard
// deviations.
constexpr double MAX_OF_RECENT = 2.4;
// If a dipole moves by the fraction s > 0.4 of its distance between two readings, the ratio of
// their difference to the previous differences is less than this times s^3 in 99.9 % of the cases
// (simulated).
constexpr double RATIO_PER_CUBE = 130.0;
// [T] Typical maximum step of magnetometers. With the default threshold, steps of up to 1.3e-5 T
// are not classified as spikes.
constexpr double MAX_STEP = 1.5e-6;
// Maximum difference between the fields after and before a spike, relative to the spike.
constexpr double MAX_RETURN = 0.3;

// The reading passes; it is held; the held readings are a spike (call again for the reading
// itself); the held readings and the current reading pass, in order.
enum Verdict { PASSES, HELD, SPIKE, RELEASED };

// Whether the current run of equal readings is too long to be due to chance.
inline bool is_too_long(const Sensor& s) {
    if (s.run < MIN_RUN || s.changes < MIN_CHANGES) return false;
    const double usual = (s.repeats + 1.0) / (s.repeats + s.changes + 2.0);
    return usual < COARSE_FRACTION && double(s.run) * std::log(usual) < MIN_LOG_PROBABILITY;
}

// Records a reading `field` (3) [T], NaN for a missing axis. Returns whether it has been repeated for
// longer than chance or coarse steps can explain.
inline bool is_stuck(Sensor& s, const double* field) {
    bool is_same = true;
    for (int a = 0; a < 3; ++a) {
        if (!(field[a] == s.last[a] || (std::isnan(field[a]) && std::isnan(s.last[a]))))
            is_same = false;
        s.last[a] = field[a];
    }
    if (is_same) {
        ++s.run;
        return is_too_long(s);
    }
    // A faulty run counts only once. If it did not count at all, a sensor with coarse steps that
    // started during a pass would be classified as stuck at rest.
    if (s.run) {
        s.repeats += is_too_long(s) ? 1.0 : double(s.run);
        s.run = 0;
    }
    s.changes += 1.0;
    if (s.repeats + s.changes > MEMORY) s.repeats *= 0.5, s.changes *= 0.5;
    return false;
}

// Largest recent difference [T] of axis `a` between readings; NaN if none is known.
inline double largest_recent(const Sensor& s, int a) {
    double largest = 0.0;
    bool is_known = false;
    for (const auto& steps : s.steps)
        if (!std::isnan(steps[a])) largest = std::max(largest, steps[a]), is_known = true;
    return is_known ? largest : NAN;
}

// Standard deviation [T] of axis `a`; before the noise is known, from recent differences.
inline double usual_noise(const Sensor& s, int a) {
    if (s.is_ready) return s.noise_std[a];
    // An axis that has been constant so far is assumed to have the steps of the other axes.
    const double step = std::isfinite(s.step[a])
                            ? s.step[a]
                            : std::min({s.step[0], s.step[1], s.step[2], MAX_STEP});
    return std::max(largest_recent(s, a) / MAX_OF_RECENT, step / std::sqrt(12.0));
}

// Whether the differences `steps` (3) [T] from the previous reading are larger than a target can
// cause.
inline bool is_off(const Sensor& s, double threshold, int64_t stamp, const double* steps) {
    // A comparison with NaN is false: a missing axis is no spike.
    bool is_high = false;
    for (int a = 0; a < 3; ++a) is_high |= steps[a] > threshold * usual_noise(s, a);
    if (!is_high) return false;
    const double passed = MAX_RATE * double(stamp - s.before_ns) * 1e-9;
    const double ratio = std::max(MIN_RATIO, RATIO_PER_CUBE * passed * passed * passed);
    for (int a = 0; a < 3; ++a) {
        const double noise = usual_noise(s, a), largest = largest_recent(s, a);
        // A sensor with coarse steps may not have changed recently, hence the comparison with the
        // noise. A comparison with NaN is false: an axis without recent differences is not
        // evaluated.
        if (largest >= 0.0 && steps[a] > threshold * noise && steps[a] > ratio * noise
            && steps[a] > ratio * largest)
            return true;
    }
    return false;
}

// A reading with its own covariance (3, 3) [T^2], which is used if `own` is not zero.
struct Reading {
    int64_t stamp;
    const double* field;
    int64_t own;
    const double* covariance;
};

// Store a reading at index `k` of the held readings.
inline void store(Sensor& s, int64_t k, const Reading& reading) {
    s.held_ns[k] = reading.stamp, s.held_own[k] = reading.own;
    for (int a = 0; a < 3; ++a) {
        s.held_field[k][a] = reading.field[a];
        for (int b = 0; b < (reading.own ? 3 : 0); ++b)
            s.held_covariance[k][a][b] = reading.covariance[3 * a + b];
    }
}

// Append a reading, with the differences `steps` (3) from the previous one, to the held readings.
inline void hold(Sensor& s, const Reading& reading, const double* steps) {
    store(s, s.n_held, reading);
    for (int a = 0; a < 3; ++a) s.held_steps[s.n_held][a] = steps[a];
    ++s.n_held;
}

// Record a reading that passes, for comparison with the next reading. `steps` may be nullptr.
inline void pass(Sensor& s, const Reading& reading, const double* steps) {
    double* slot = s.steps[s.n_steps % N_RECENT];
    for (int a = 0; a < 3; ++a) {
        s.before[a] = reading.field[a];
        if (steps != nullptr) slot[a] = steps[a];
    }
    s.before_ns = reading.stamp;
    s.n_steps += steps != nullptr;
}

// Whether the field has returned to its value before the held readings.
inline bool has_returned(const Sensor& s, const double* steps) {
    // The axis with the largest difference decides.
    int axis = 0;
    double highest = -1.0;
    for (int a = 0; a < 3; ++a) {
        double largest = 0.0;
        for (int64_t k = 0; k < s.n_held; ++k)
            if (s.held_steps[k][a] > largest) largest = s.held_steps[k][a];
        if (largest > highest) axis = a, highest = largest;
    }
    return steps[axis] <= MAX_RETURN * highest;
}

// Classify a reading and the held readings before it.
//
// A reading is held if it differs from the previous one by more than `threshold` standard
// deviations of the noise and by more than `MIN_RATIO` times the recent differences, since a
// vehicle approaches smoothly. If the rate is so low that a target may pass between two readings,
// the ratio is larger. Before the noise is known (not `is_ready`), it is estimated from the recent
// differences.
inline Verdict screen_spike(Sensor& s, double threshold, const Reading& reading) {
    double steps[3] = {NAN, NAN, NAN};
    // At most MAX_HELD readings are held when a reading arrives.
    if (s.n_held > MAX_HELD) throw std::out_of_range("n_held of a sensor exceeds its maximum");
    if (s.before_ns == NEVER) {
        if (s.n_held) {
            hold(s, reading, steps);
            s.n_released = s.n_held;
        }
        pass(s, reading, nullptr);
        return s.n_held ? RELEASED : PASSES;
    }
    for (int a = 0; a < 3; ++a) steps[a] = std::abs(reading.field[a] - s.before[a]);
    if (s.n_held) {
        if (has_returned(s, steps)) return SPIKE;
        hold(s, reading, steps);
        if (s.n_held <= MAX_HELD) return HELD;
        // A step: the earlier differences are not representative any more.
        s.n_steps = 0, s.n_released = s.n_held;
        pass(s, reading, nullptr);
        return RELEASED;
    }
    if (s.n_steps >= N_RECENT && is_off(s, threshold, reading.stamp, steps)) {
        hold(s, reading, steps);
        return HELD;
    }
    pass(s, reading, steps);
    return PASSES;
}

}  // namespace mag_tracking
