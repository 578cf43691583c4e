// Alignment of individual samples into frames.
//
// All rules of the alignment are implemented here. An event that Python must handle (a rejection
// that is counted by name, a clock step, a complete frame, ...) is returned as a reason code.

#pragma once

#include <algorithm>
#include <cmath>
#include <deque>
#include <limits>
#include <vector>

#include "../../units.hpp"

namespace mag_tracking {

enum Reason {
    // DONE: the batch is finished. The other codes: the sample has been rejected.
    DONE,
    UNKNOWN_SENSOR,
    NO_FIELD,
    NO_COVARIANCE,
    DUPLICATE,
    OUT_OF_ORDER,
    LATE,
    // Time has restarted; must be handled before the same sample is processed again.
    JUMPED_BACK,
    // CLOCK_STEP: the clock may have stepped, and the sample was not added. TOO_MANY: the sensor
    // has more pending samples than allowed. COMPLETE: the next frame is complete.
    CLOCK_STEP,
    TOO_MANY,
    COMPLETE
};

// Later than any timestamp.
constexpr int64_t FAR = std::numeric_limits<int64_t>::max();

// [ns] Frame period, maximum wait for a silent sensor, maximum forward jump of a timestamp, and
// backward jump above which time restarts; maximum number of pending samples per sensor; whether
// the sensors are read sequentially.
struct AlignmentSettings {
    int64_t period, wait, limit, jump_back, most;
    bool is_burst;
};

struct Sample {
    int64_t stamp;
    double field[3], covariance[9];
};

// The pending samples of a sensor, in chronological order.
using Queue = std::deque<Sample>;

// Samples of a batch: sensor indices (negative for an unknown sensor), timestamps, fields and
// covariances.
struct Samples {
    int64_t n;
    const int64_t *rows, *stamps;
    const double *fields, *covariances;
};

// Output arrays of a frame: (n, 3), (n, 3, 3), (n,), (n,); initialised to zero.
struct FrameArrays {
    double *field, *covariance;
    int64_t* n_samples;
    double* time_offset;
};

// Reason why a sample, field (3) and covariance (3, 3), cannot be used, or DONE.
inline Reason fault(const double* field, const double* covariance) {
    int n_missing = 0;
    for (int a = 0; a < 3; ++a) {
        if (std::isinf(field[a])) return NO_FIELD;
        n_missing += std::isnan(field[a]);
    }
    if (n_missing == 3) return NO_FIELD;
    for (int i = 0; i < 9; ++i)
        if (!std::isnan(covariance[i])) return DONE;
    return NO_COVARIANCE;
}

class Alignment {
  public:
    Alignment(std::size_t n_sensors, const AlignmentSettings& settings)
        : settings_(settings), queues_(n_sensors), latest_(n_sensors, NEVER),
          taken_(n_sensors, NEVER) {
        look_ahead();
    }

    // Index of the next sample of the batch; index of the sensor that the latest reason refers to;
    // newest timestamp that passed the clock step filter; whether no clock step is suspected,
    // so that samples within the jump limit bypass the filter.
    int64_t next = 0, row = 0, passed = NEVER;
    bool is_calm = true;

    int64_t n_sensors() const { return int64_t(queues_.size()); }

    int64_t n_pending() const {
        int64_t n = 0;
        for (const Queue& queue : queues_) n += int64_t(queue.size());
        return n;
    }

    // Drop the oldest pending sample of a sensor, if there is one.
    void drop(int64_t i) {
        if (queues_[i].size()) queues_[i].pop_front();
        look_ahead();
    }

    // Queue samples, starting at `next`, until Python must handle an event. If `is_checked`, the
    // samples have already passed the clock step filter. `passed_latest` (n) [ns] is the
    // latest timestamp of each sensor that passed the filter.
    Reason hold(bool is_checked, int64_t* passed_latest, const Samples& in) {
        while (next < in.n) {
            const int64_t k = next++, i = row = in.rows[k], t = in.stamps[k];
            if (i < 0) return UNKNOWN_SENSOR;
            const double *field = in.fields + 3 * k, *covariance = in.covariances + 9 * k;
            Reason reason = fault(field, covariance);
            if (reason != DONE) return reason;
            if (!is_checked) {
                if (!is_calm || (passed != NEVER && t - passed > settings_.limit))
                    return CLOCK_STEP;
                passed_latest[i] = t;
                passed = std::max(passed, t);
            }
            reason = place(latest_[i], t);
            if (reason == JUMPED_BACK) next = k;
            if (reason != DONE) return reason;
            if (queues_[i].size() == 0) bring_forward(t, taken_[i]);
            Sample& sample = queues_[i].emplace_back();
            sample.stamp = t;
            std::copy(field, field + 3, sample.field);
            std::copy(covariance, covariance + 9, sample.covariance);
            if (int64_t(queues_[i].size()) > settings_.most) return TOO_MANY;
            if (!waits()) return COMPLETE;
        }
        return DONE;
    }

    // Whether the next frame must wait for a sensor.
    bool waits() {
        const bool is_young = newest_ - first_ < settings_.wait;
        // At the start of the input, a frame that ends at a negative time does not wait if any
        // sensor has not delivered a sample yet.
        if (due_ < 0 && is_young
            && std::find(latest_.begin(), latest_.end(), NEVER) != latest_.end())
            return false;
        return is_one_behind() && (!settings_.is_burst || is_one_missing(is_young));
    }

    // Find the end of the next frame, and reset the watched sensor. Returns false if no sample is
    // pending.
    bool look_ahead() {
        window_ = settings_.period;
        start_ = due_ = FAR;
        watch_ = -1;
        int64_t earliest = FAR;
        for (std::size_t i = 0; i < queues_.size(); ++i) {
            if (queues_[i].size() == 0) continue;
            const int64_t oldest = queues_[i].front().stamp;
            if (settings_.is_burst) bring_forward(oldest, taken_[i]);
            earliest = std::min(earliest, oldest);
        }
        // Unless the sensors are read sequentially, only the oldest sample determines the frame.
        if (!settings_.is_burst && earliest != FAR) bring_forward(earliest, NEVER);
        return due_ != FAR;
    }

    // Average the samples before the end of the next frame (in burst mode one per sensor) and
    // return the timestamp of the frame. Requires at least one sample.
    int64_t frame(const FrameArrays& out) {
        const int64_t end = due_;
        int64_t first = FAR, newest = NEVER, n_all = 0, since_all = 0;
        std::vector<int64_t> since(queues_.size(), 0);
        for (std::size_t i = 0; i < queues_.size(); ++i) {
            Queue& queue = queues_[i];
            int64_t& n = out.n_samples[i];
            double n_axis[3] = {0.0, 0.0, 0.0};
            if (queue.size() && queue.front().stamp < end)
                first = std::min(first, queue.front().stamp);
            while (queue.size() && queue.front().stamp < end && !(settings_.is_burst && n)) {
                const Sample& sample = queue.front();
                ++n;
                since[i] += sample.stamp - end;
                taken_[i] = sample.stamp;
                newest = std::max(newest, sample.stamp);
                add(sample, n_axis, out.field + 3 * i, out.covariance + 9 * i);
                queue.pop_front();
            }
            average(n, n_axis, out.field + 3 * i, out.covariance + 9 * i);
            n_all += n, since_all += since[i];
        }
        last_taken_ = std::max(last_taken_, newest);
        end_ = settings_.is_burst ? newest + 1 : end;
        // Rounds of sensors with different rates overlap; the offsets preserve the sample times.
        const double mean = double(since_all + n_all * (end - first)) / double(n_all);
        stamp_ = std::max(first + int64_t(std::nearbyint(mean)),
                          stamp_ == NEVER ? NEVER : stamp_ + 1);
        for (std::size_t i = 0; i < queues_.size(); ++i) {
            const int64_t n = out.n_samples[i];
            out.time_offset[i] = double(since[i] + n * (end - stamp_))
                                 / double(std::max<int64_t>(n, 1)) / 1e9;
        }
        return stamp_;
    }

  private:
    static void add(const Sample& sample, double* n_axis, double* field, double* covariance) {
        for (int a = 0; a < 3; ++a) {
            if (std::isnan(sample.field[a])) continue;
            n_axis[a] += 1.0;
            field[a] += sample.field[a];
        }
        for (int a = 0; a < 9; ++a) covariance[a] += sample.covariance[a];
    }

    // Divide the sums over n samples by the counts; NaN for an axis that is missing in all samples.
    static void average(int64_t n, const double* n_axis, double* field, double* covariance) {
        double fewest = NAN;
        for (int a = 0; a < 3; ++a) {
            field[a] = n_axis[a] > 0.0 ? field[a] / n_axis[a] : NAN;
            if (n_axis[a] > 0.0) fewest = std::fmin(fewest, n_axis[a]);
        }
        // The smallest count of any axis is used for all axes, so no variance is underestimated.
        const double divisor = double(std::max<int64_t>(n, 1)) * fewest;
        for (int a = 0; a < 9; ++a) covariance[a] /= divisor;
    }

    // Whether a sensor is active and may still deliver a sample that belongs to the frame.
    bool is_behind(int64_t latest) const {
        if (latest == NEVER) return newest_ - first_ < settings_.wait;
        return newest_ - settings_.wait <= latest && latest < due_;
    }

    // Whether any sensor is behind. The first such sensor is watched: the next call
    // checks it first.
    bool is_one_behind() {
        if (watch_ >= 0 && is_behind(latest_[watch_])) return true;
        for (std::size_t j = 0; j < latest_.size(); ++j)
            if (is_behind(latest_[j])) {
                watch_ = int64_t(j);
                return true;
            }
        return false;
    }

    // Whether any sensor may still deliver its sample of this round.
    bool is_one_missing(bool is_young) const {
        for (std::size_t i = 0; i < queues_.size(); ++i) {
            if (queues_[i].size()) {
                if (queues_[i].front().stamp >= due_) return true;
            } else if (latest_[i] == NEVER) {
                if (is_young) return true;
                // All samples of the sensor are in earlier frames. At the start of a round, the latest
                // samples of the other sensors are one round old.
            } else if (last_taken_ == NEVER || latest_[i] >= last_taken_ - settings_.wait) {
                return true;
            }
        }
        return false;
    }

    // Start the next frame early enough to include the oldest pending sample of a sensor. `taken`
    // is the timestamp of the latest sample of this sensor in a frame, or NEVER.
    void bring_forward(int64_t stamp, int64_t taken) {
        if (settings_.is_burst) {
            // A round lasts at most the period, or half the sample interval of any sensor.
            if (taken != NEVER)
                window_ = std::min(window_, std::max<int64_t>(1, (stamp - taken) / 2));
        } else if (end_ != NEVER && stamp < end_ + settings_.period) {
            stamp = end_;
        }
        start_ = std::min(start_, stamp);
        due_ = start_ + window_;
    }

    // Check the timestamp of a sample and update `latest`, the latest timestamp of its sensor.
    // Returns the reason why the timestamp cannot be used, or DONE.
    Reason place(int64_t& latest, int64_t stamp) {
        if (latest != NEVER && stamp <= latest) {
            if (latest - stamp > settings_.jump_back) return JUMPED_BACK;
            return stamp == latest ? DUPLICATE : OUT_OF_ORDER;
        }
        latest = stamp;
        if (stamp < end_) return LATE;
        first_ = newest_ == NEVER ? stamp : std::min(first_, stamp);
        newest_ = std::max(newest_, stamp);
        return DONE;
    }

    AlignmentSettings settings_;
    std::vector<Queue> queues_;
    // [ns] Per sensor: latest timestamp, and latest timestamp of its samples in frames.
    std::vector<int64_t> latest_, taken_;
    // Oldest and newest timestamp; end and timestamp of the latest frame, and newest sample in any
    // frame; earliest start, end and length of the next frame; index of the watched sensor, or -1.
    int64_t first_ = NEVER, newest_ = NEVER, end_ = NEVER, stamp_ = NEVER, last_taken_ = NEVER;
    int64_t start_ = FAR, due_ = FAR, window_ = 0, watch_ = -1;
};

}  // namespace mag_tracking
