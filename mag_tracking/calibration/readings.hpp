// Calibration of readings one by one.
//
// This file contains all rules for single readings. A case that requires Python (a rejection that
// is counted by name, a complete block, a clock that jumped back, ...) is returned as a reason, and
// `calibrate` continues where it stopped.

#pragma once

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "blocks.hpp"
#include "resolution.hpp"
#include "screening.hpp"

namespace mag_tracking {

enum Reason {
    // The batch is finished, or the reading is rejected.
    DONE,
    UNKNOWN_SENSOR,
    NO_AXIS,
    INFINITE,
    TOO_LARGE,
    BAD_COVARIANCE,
    AXIS_MISSING,
    TOO_FAR_AHEAD,
    DUPLICATE,
    OUT_OF_ORDER,
    STUCK,
    MARKED,
    REPEATED,
    // To be handled before the same reading is processed again.
    BLOCK_COMPLETE = 20,
    JUMPED_BACK,
    RESTORABLE,
    WINDOW_COMPLETE,
    // The previous `n_spikes` readings are rejected, or the `n_released` held readings are to be
    // used.
    SPIKES = 30,
    PASSED
};

// Maximum difference between the correlation of two axes in a message and the measured correlation.
constexpr double MAX_CORRELATION = 0.7;
// Maximum ratio between the variance in a message and the measured variance.
constexpr double MAX_VARIANCE_RATIO = 25.0;

// Whether a reading has its own covariance.
enum Own { NONE, VALID, INVALID };

// Limits of `CalibrateSettings`.
struct Limits {
    double max_field, longest_jump_ns, jump_back_ns;
    int64_t reject_stuck;
    double spike_std;
    int64_t is_decimated, trust_covariances;
};

// Progress within a batch: index of the next reading; sensor and timestamp of the reading that a
// reason refers to; numbers of calibrated readings, of spikes, of readings without a background
// yet, of readings with an axis without a background yet, and of readings whose covariance was
// overruled.
struct Batch {
    int64_t next, row, n_out, n_spikes, n_learning, n_partly_learning, n_overruled, stamp_ns;
};

// n readings: indices of their sensors (negative: unknown), timestamps [ns], raw fields (n, 3) [T],
// `Own`, and covariances (n, 3, 3) [T^2], which are read if `own` is not NONE.
struct RawReadings {
    int64_t n;
    const int64_t *rows, *stamps;
    const double* fields;
    const int64_t* own;
    const double* covariances;
};

// Output arrays of calibrated readings, with a capacity of n.
struct Calibrated {
    int64_t n;
    int64_t *rows, *stamps;
    double *fields, *covariances;
};

// Copies a raw reading `in` (3) to `raw`, with NaN for the axes that have a mark for a missing
// reading. Returns the number of these axes.
inline int remove_marks(const Sensor& s, const double* in, double* raw) {
    int n = 0;
    for (int a = 0; a < 3; ++a) raw[a] = in[a];
    for (int64_t k = 0; k < s.n_marks; ++k) {
        const auto& mark = s.marks[k];
        bool is_marked = true;
        for (int a = 0; a < 3; ++a) is_marked &= std::isnan(mark[a]) || in[a] == mark[a];
        for (int a = 0; is_marked && a < 3; ++a)
            if (!std::isnan(mark[a]) && !std::isnan(raw[a])) raw[a] = NAN, ++n;
    }
    return n;
}

// Adds a raw reading to the window. Readings with a repeated timestamp are published twice and do not
// show how often the sensor measures.
inline void note_raw(Sensor& s, int64_t stamp, const double* raw, bool is_duplicate) {
    if (is_duplicate || s.n_window >= N_WINDOW) return;
    s.window_ns[s.n_window] = stamp;
    for (int a = 0; a < 3; ++a) s.window[s.n_window][a] = raw[a];
    ++s.n_window;
}

// Whether a raw reading equals the latest one of a sensor that is read faster than it measures.
inline bool is_repeated(Sensor& s, const double* raw) {
    bool is_same = s.repetition > 1.0;
    for (int a = 0; a < 3; ++a) {
        is_same &= raw[a] == s.latest[a] || (std::isnan(raw[a]) && std::isnan(s.latest[a]));
        s.latest[a] = raw[a];
    }
    return is_same;
}

// Reason for the rejection of a raw reading, or DONE.
inline Reason field_fault(const Limits& limits, const double* raw, int64_t own) {
    double largest = 0.0;
    bool is_known = false;
    for (int a = 0; a < 3; ++a)
        if (!std::isnan(raw[a])) largest = std::max(largest, std::abs(raw[a])), is_known = true;
    if (!is_known) return NO_AXIS;
    if (std::isinf(largest)) return INFINITE;
    if (largest > limits.max_field) return TOO_LARGE;
    return own == INVALID && limits.trust_covariances ? BAD_COVARIANCE : DONE;
}

// Product that is zero for a zero coefficient, even if the axis is missing (NaN).
inline double product(double coefficient, double value) {
    return coefficient == 0.0 ? 0.0 : coefficient * value;
}

// Correct hard and soft iron of the sensor, from `raw` into `field`; false if no axis remains.
//
// All corrected axes that depend on a missing raw axis are missing.
inline bool remove_iron(const Sensor& s, const double* raw, double* field) {
    double v[3];
    bool is_known = false;
    for (int a = 0; a < 3; ++a) v[a] = field[a] = raw[a] - s.offset[a];
    for (int a = 0; a < 3; ++a) {
        const auto& c = s.correction[a];
        if (s.has_correction)
            field[a] = product(c[0], v[0]) + product(c[1], v[1]) + product(c[2], v[2]);
        is_known |= !std::isnan(field[a]);
    }
    return is_known;
}

// Reason for the rejection of a timestamp, or DONE.
inline Reason timestamp_fault(Sensor& s, const Limits& limits, int64_t stamp) {
    if (s.last_ns != NEVER) {
        if (double(stamp - s.last_ns) > limits.longest_jump_ns) {
            const int64_t before = s.unconfirmed_ns;
            if (before == NEVER || stamp <= before
                || double(stamp - before) > limits.longest_jump_ns) {
                s.unconfirmed_ns = stamp;
                return TOO_FAR_AHEAD;
            }
        } else {
            s.unconfirmed_ns = NEVER;
        }
        if (stamp <= s.last_ns) {
            if (double(s.last_ns - stamp) > limits.jump_back_ns) return JUMPED_BACK;
            return stamp == s.last_ns ? DUPLICATE : OUT_OF_ORDER;
        }
    }
    if (s.is_restorable) return RESTORABLE;
    s.last_ns = stamp;
    if (s.first_ns == NEVER) s.first_ns = stamp;
    return DONE;
}

// Reason for the rejection or delay of a reading `in` (3), or DONE. Writes the raw reading without
// marks to `raw`, and the reading, corrected for iron, to `field`.
inline Reason check(Sensor& s, const Limits& limits, int64_t stamp, const double* in, int64_t own,
                    double* raw, double* field) {
    if (s.is_full) return BLOCK_COMPLETE;
    if (s.n_window >= s.window_due) return WINDOW_COMPLETE;
    const int n_marked = remove_marks(s, in, raw);
    Reason reason = field_fault(limits, raw, own);
    if (reason == NO_AXIS && n_marked) {
        ++s.n_marked;
        return MARKED;
    }
    if (reason != DONE) return reason;
    if (!remove_iron(s, raw, field)) return AXIS_MISSING;
    reason = timestamp_fault(s, limits, stamp);
    if (reason != DONE) return reason;
    if (is_repeated(s, raw)) return REPEATED;
    s.n_marked += n_marked > 0;
    return limits.reject_stuck && is_stuck(s, field) ? STUCK : DONE;
}

// Applies `screen_spike`, and counts the spikes.
inline Verdict screen(Sensor& s, const Limits& limits, Batch& batch, const Reading& reading) {
    if (limits.spike_std <= 0.0) return PASSES;
    const Verdict verdict = screen_spike(s, limits.spike_std, reading);
    if (verdict != SPIKE) return verdict;
    batch.n_spikes += s.n_held;
    s.n_held = 0;
    return screen_spike(s, limits.spike_std, reading);
}

// Whether the covariance `C` (3, 3) of a message is consistent with the noise of the sensor.
inline bool is_credible(const Sensor& s, const double* C) {
    for (int a = 0; a < 3; ++a) {
        const double stated = C[4 * a], known = s.noise[a][a] + s.step_variance[a];
        // A comparison with NaN is false: a missing axis is not inconsistent.
        if (stated > MAX_VARIANCE_RATIO * known || known > MAX_VARIANCE_RATIO * stated)
            return false;
        for (int b = 0; b < a; ++b) {
            // The correlation in the message must be close to the measured correlation.
            const double both = std::sqrt(stated * C[4 * b]);
            const double measured = s.noise[a][b]
                                    / std::sqrt(known * (s.noise[b][b] + s.step_variance[b]));
            if (std::abs(C[3 * a + b] / both - measured) > MAX_CORRELATION) return false;
        }
    }
    return true;
}

// Writes the covariance of a reading to `out` (3, 3): the covariance in the message if it is
// credible, otherwise the noise of the sensor. The variance of a provisional background is added.
// Counts overruled covariances.
inline void attach_covariance(Sensor& s, const Limits& limits, Batch& batch, const Reading& reading,
                              double* out) {
    const double* C = reading.covariance;
    bool own = reading.own != NONE;
    if (own && !limits.trust_covariances && (reading.own == INVALID || !is_credible(s, C))) {
        own = false;
        ++s.n_overruled, ++batch.n_overruled;
        for (int a = 0; a < 3; ++a) s.stated_std[a] = C[4 * a] >= 0.0 ? std::sqrt(C[4 * a]) : NAN;
    }
    for (int a = 0; a < 3; ++a) {
        for (int b = 0; b < 3; ++b) out[3 * a + b] = own ? C[3 * a + b] : s.noise[a][b];
        if (!(own && limits.trust_covariances))
            out[4 * a] += s.step_variance[a] * rest_of(s, a) / s.n_averaged;
        out[4 * a] += s.level_variance[a];
    }
}

// Calibrates a reading of the sensor `row`. Returns false, without using the reading, if a complete
// block must be evaluated first.
inline bool use(Sensor& s, const Limits& limits, Batch& batch, int64_t row, const Reading& reading,
                const Calibrated& out) {
    const double time = double(reading.stamp - s.first_ns) / 1e9;
    begin_block_if_due(s, time);
    if (s.is_full && std::isnan(s.phase)) return false;
    collect(s, time, reading.field);
    if (!s.is_ready) {
        ++batch.n_learning;
        return true;
    }
    const int64_t k = batch.n_out;
    if (k < 0 || k >= out.n) throw std::out_of_range("the output arrays are full");
    double *field = out.fields + 3 * k, *C = out.covariances + 9 * k;
    subtract_background(s, time, reading.field, field);
    attach_covariance(s, limits, batch, reading, C);
    int n_missing = 0;
    bool is_new = false;
    for (int a = 0; a < 3; ++a) {
        // The background of an axis that has just started to report is unknown.
        if (!std::isnan(reading.field[a]) && (std::isnan(field[a]) || !(C[4 * a] > 0.0))) {
            is_new = true;
            field[a] = NAN;
            for (int b = 0; b < 3; ++b) C[3 * a + b] = C[3 * b + a] = NAN;
        }
        n_missing += std::isnan(field[a]);
    }
    batch.n_partly_learning += is_new;
    if (n_missing < 3) {
        out.rows[k] = row, out.stamps[k] = reading.stamp;
        ++batch.n_out;
    }
    return true;
}

// Covariance `C` (3, 3) of a raw reading after the soft-iron correction, into `out`.
inline void correct_covariance(const Sensor& s, const double* C, double* out) {
    for (int i = 0; i < 9; ++i) out[i] = s.has_correction ? 0.0 : C[i];
    if (!s.has_correction) return;
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b)
            for (int c = 0; c < 3; ++c)
                for (int d = 0; d < 3; ++d)
                    out[3 * a + b] += product(s.correction[a][c] * s.correction[b][d],
                                              C[3 * c + d]);
}

// Calibrate readings from `next` on, until the batch is finished or Python is required.
inline Reason calibrate(Sensor* sensors, const Limits& limits, const RawReadings& in, Batch& batch,
                        const Calibrated& out) {
    double raw[3], field[3], C[9];
    while (batch.next < in.n) {
        const int64_t i = batch.next++, row = batch.row = in.rows[i];
        if (row < 0) return UNKNOWN_SENSOR;
        Sensor& s = sensors[row];
        const int64_t stamp = batch.stamp_ns = in.stamps[i] - s.clock_offset_ns;
        const bool is_duplicate = stamp == s.last_ns;
        const Reason reason = check(s, limits, stamp, in.fields + 3 * i, in.own[i], raw, field);
        if (reason >= BLOCK_COMPLETE)
            batch.next = i;
        else
            note_raw(s, stamp, in.fields + 3 * i, is_duplicate);
        if (reason != DONE) return reason;
        if (in.own[i]) correct_covariance(s, in.covariances + 9 * i, C);
        const Reading reading{stamp, field, in.own[i], C};
        const Verdict verdict = screen(s, limits, batch, reading);
        // Spikes do not update the steps of the sensor.
        if (verdict == PASSES || verdict == RELEASED) note_step(s, stamp, raw);
        if (verdict == PASSES) {
            ++s.accepted;
            if (!limits.is_decimated && use(s, limits, batch, row, reading, out)) {
                if (batch.n_spikes) return SPIKES;
                continue;
            }
            // The reading passes, but it cannot be used until Python has handled it.
            store(s, 0, reading);
            s.n_held = s.n_released = 1;
        } else if (verdict != HELD) {
            s.accepted += s.n_released;
        }
        if (s.n_released) return PASSED;
        if (batch.n_spikes) return SPIKES;
    }
    return DONE;
}

}  // namespace mag_tracking
