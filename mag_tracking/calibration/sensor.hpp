// State of one sensor, updated with every reading, in [T] and [s], or in [ns] if the name ends with
// `_ns`. Compiled code accesses it for each reading, Python for each block, as an element of a
// structured array (`SENSOR`) whose fields are listed in core.cpp.

#pragma once

#include "../units.hpp"

namespace mag_tracking {

// Number of differences between consecutive readings that a spike is compared with.
constexpr int N_RECENT = 8;
// Maximum number of readings of a spike; a longer change is a step.
constexpr int MAX_HELD = 3;
// Number of raw readings in which faults of the driver are searched.
constexpr int N_WINDOW = 512;
// Maximum number of values that mark a missing reading.
constexpr int MAX_MARKS = 4;

struct Sensor {
    // From the network file: clock offset, hard iron, soft iron.
    int64_t clock_offset_ns;
    double offset[3];
    int64_t has_correction;
    double correction[3][3];
    // Background line and noise of one reading, fitted by `background.RunningBackground`.
    int64_t is_ready;
    double centre, mean[3], slope[3], horizon, noise[3][3], noise_std[3];
    // Variance of that line if it is provisional, else 0.
    double level_variance[3];
    // First and latest timestamp; a timestamp that is too far ahead and not yet confirmed; whether
    // a stored background may be restored at the next reading.
    int64_t first_ns, last_ns, unconfirmed_ns, is_restorable, accepted;
    // Faults of the driver, found in the latest raw readings when their number is `window_due`: marks
    // for missing readings (NaN: any value of the axis), the number of readings with a mark
    // on any axis, and the number of readings per measurement.
    double window[N_WINDOW][3];
    int64_t window_ns[N_WINDOW];
    int64_t n_window, window_due, n_marks;
    double marks[MAX_MARKS][3];
    int64_t n_marked;
    double repetition, latest[3];
    // Repetition: the latest reading, the length of the current run of equal readings, and the
    // numbers of readings that were equal to the previous reading, or differed.
    double last[3];
    int64_t run;
    double repeats, changes;
    // Resolution: the latest value of each raw axis, the time of its latest change and
    // the number of readings since then, the numbers of repetitions and changes, the smallest
    // change, and the variance due to the steps; the number of raw readings in a decimated
    // reading.
    double raw[3];
    int64_t rest_since_ns[3], n_rest[3], n_same[3], n_changed[3];
    double step[3], step_variance[3], n_averaged;
    // Covariances of the messages: the latest overruled standard deviations, and the number of
    // overruled covariances.
    double stated_std[3];
    int64_t n_overruled;
    // Spikes: the latest reading that passed, the differences before it, and the held readings, of
    // which `n_released` have passed and wait to be used.
    int64_t before_ns;
    double before[3];
    int64_t n_steps;
    double steps[N_RECENT][3];
    int64_t n_held, n_released, held_ns[MAX_HELD + 1];
    double held_field[MAX_HELD + 1][3], held_steps[MAX_HELD + 1][3];
    int64_t held_own[MAX_HELD + 1];
    double held_covariance[MAX_HELD + 1][3][3];
    // Blocks: length of a block, relative extra length of the first block (NaN: blocks are
    // not staggered, and each is evaluated at once), end of the current block, index of the current
    // block, and whether the other block is complete.
    double length, phase, end;
    int64_t now, is_full;
    // Sums of both blocks, relative to the first reading of each block. The sums of a pair of axes
    // include the readings with both axes.
    int64_t n[2];
    double time[2], origin[2][3], count[2][3][3], sum[2][3][3], product[2][3][3];
};

}  // namespace mag_tracking
