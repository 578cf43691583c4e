// Faulty readings of one sensor: spikes, and a sensor that is stuck.
//
// Only a suspect reading is held until the next ones decide; all others pass at once.

#pragma once

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "sensor.hpp"

namespace mag_tracking {

// Readings over which the usual share of repetitions is counted, about.
constexpr double MEMORY = 20'000.0;
// A sensor that has changed less often may have steps so coarse that it repeats itself for long.
constexpr double MIN_CHANGES = 50.0;
// A run of equal readings is a fault where chance makes it no more often than this.
const double LIKELY = std::log(1e-9);
constexpr int MIN_RUN = 4;
// A sensor that repeats itself more often has steps so coarse that at rest it may do so for ever;
// with a noise of one step or more, on three axes, the share is below this.
constexpr double COARSE = 0.05;
// A spike is steeper than the steepest recent difference by this factor, and by more where readings
// are rare.
constexpr double STEEPER = 8.0;
// [1/s] Highest speed of a target, in units of its distance: 30 m/s at one metre.
constexpr double FASTEST = 30.0;
// Largest of `RECENT` differences between readings of white noise, in its standard deviations; the
// mean.
constexpr double MAX_OF_RECENT = 2.4;
// A dipole that moves by the share s of its distance between two readings, s above 0.4, makes a
// difference steeper than the ones before by less than this times s^3, in 99.9 % of the cases
// (simulated).
constexpr double STEEPEST = 130.0;
// [T] Steps of magnetometers are hardly larger than this. With the usual threshold steps of up to
// 1.3e-5 T do not make a spike by it.
constexpr double COARSEST = 1.5e-6;
// After a spike the field is again where it was, to this share of the spike.
constexpr double BACK = 0.3;

// The reading passes; it is held; what was held is a spike (call again for the reading itself); the
// held readings and this one pass, in order.
enum Verdict { PASSES, HELD, SPIKE, RELEASED };

// Whether the present run of equal readings is longer than chance makes it.
inline bool is_too_long(const Sensor& s) {
    if (s.run < MIN_RUN || s.changes < MIN_CHANGES) return false;
    const double usual = (s.repeats + 1.0) / (s.repeats + s.changes + 2.0);
    return usual < COARSE && double(s.run) * std::log(usual) < LIKELY;
}

// Whether a reading `field` (3) [T], NaN = missing axis, repeats the one before for longer than
// chance, or coarse steps, allow.
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
    // A run that is a fault says little about what is usual. But if it counted for nothing, a sensor
    // with coarse steps that started while a target passed would be stuck at rest.
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
    // An axis that has only rested so far has steps like the others.
    const double step = std::isfinite(s.step[a])
                            ? s.step[a]
                            : std::min({s.step[0], s.step[1], s.step[2], COARSEST});
    return std::max(largest_recent(s, a) / MAX_OF_RECENT, step / std::sqrt(12.0));
}

// Whether `steps` (3) [T] from the reading before are steeper than any target makes them.
inline bool is_off(const Sensor& s, double threshold, int64_t stamp, const double* steps) {
    // A comparison with NaN is false: a missing axis is no spike.
    bool is_high = false;
    for (int a = 0; a < 3; ++a) is_high |= steps[a] > threshold * usual_noise(s, a);
    if (!is_high) return false;
    const double passed = FASTEST * double(stamp - s.before_ns) * 1e-9;
    const double steeper = std::max(STEEPER, STEEPEST * passed * passed * passed);
    for (int a = 0; a < 3; ++a) {
        const double noise = usual_noise(s, a), largest = largest_recent(s, a);
        // A sensor with coarse steps may not have changed at all recently. A comparison with NaN is
        // false: of an axis without recent differences nothing is known.
        if (largest >= 0.0 && steps[a] > threshold * noise && steps[a] > steeper * noise
            && steps[a] > steeper * largest)
            return true;
    }
    return false;
}

// A reading with its own covariance (3, 3) [T^2], which counts where `own` is not zero.
struct Reading {
    int64_t stamp;
    const double* field;
    int64_t own;
    const double* covariance;
};

// Store a reading at place `k` of those that are held.
inline void store(Sensor& s, int64_t k, const Reading& reading) {
    s.held_ns[k] = reading.stamp, s.held_own[k] = reading.own;
    for (int a = 0; a < 3; ++a) {
        s.held_field[k][a] = reading.field[a];
        for (int b = 0; b < (reading.own ? 3 : 0); ++b)
            s.held_covariance[k][a][b] = reading.covariance[3 * a + b];
    }
}

// Append a reading, `steps` (3) from the one before, to those that are held.
inline void hold(Sensor& s, const Reading& reading, const double* steps) {
    store(s, s.n_held, reading);
    for (int a = 0; a < 3; ++a) s.held_steps[s.n_held][a] = steps[a];
    ++s.n_held;
}

// Note a reading that passes; the next one is compared with it. Without `steps`: nullptr.
inline void pass(Sensor& s, const Reading& reading, const double* steps) {
    double* place = s.steps[s.n_steps % RECENT];
    for (int a = 0; a < 3; ++a) {
        s.before[a] = reading.field[a];
        if (steps != nullptr) place[a] = steps[a];
    }
    s.before_ns = reading.stamp;
    s.n_steps += steps != nullptr;
}

// Whether the field is again where it was before the held readings.
inline bool has_returned(const Sensor& s, const double* steps) {
    // The axis in which they are highest decides.
    int axis = 0;
    double highest = -1.0;
    for (int a = 0; a < 3; ++a) {
        double largest = 0.0;
        for (int64_t k = 0; k < s.n_held; ++k)
            if (s.held_steps[k][a] > largest) largest = s.held_steps[k][a];
        if (largest > highest) axis = a, highest = largest;
    }
    return steps[axis] <= BACK * highest;
}

// Decide on a reading and on those that are held before it.
//
// A reading is held where it differs from the one before by more than `threshold` noise deviations
// and by `STEEPER` times more than readings did recently: a vehicle approaches smoothly. Where
// readings are so rare that a target may pass between them, only a steeper difference is suspect.
// Before the noise is known (not `is_ready`), recent differences are its measure.
inline Verdict screen_spike(Sensor& s, double threshold, const Reading& reading) {
    double steps[3] = {NAN, NAN, NAN};
    // More are never held when a reading comes.
    if (s.n_held > MAX_HELD) throw std::out_of_range("n_held of a sensor: no room for another");
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
        // A step: the differences before it say nothing of what is usual now.
        s.n_steps = 0, s.n_released = s.n_held;
        pass(s, reading, nullptr);
        return RELEASED;
    }
    if (s.n_steps >= RECENT && is_off(s, threshold, reading.stamp, steps)) {
        hold(s, reading, steps);
        return HELD;
    }
    pass(s, reading, steps);
    return PASSES;
}

}  // namespace mag_tracking
