// State of one sensor that changes with every reading, in [T] and [s], or [ns] where the name says
// so. Compiled code reads and writes it reading by reading, Python block by block: it is an element
// of a structured array there (`SENSOR`), whose fields are listed in core.cpp.

#pragma once

#include "../units.hpp"

namespace mag_tracking {

// Differences between consecutive readings that a spike is compared with.
constexpr int RECENT = 8;
// A spike has at most so many readings; what lasts longer is a step.
constexpr int MAX_HELD = 3;

struct Sensor {
    // From the network file: clock offset, hard iron, soft iron.
    int64_t clock_offset_ns;
    double offset[3];
    int64_t has_correction;
    double correction[3][3];
    // Background line and noise of one reading, as `background.RunningBackground` has fitted them.
    int64_t is_ready;
    double centre, mean[3], slope[3], horizon, noise[3][3], noise_std[3];
    // Variance of that line while it is provisional, else 0.
    double level_variance[3];
    // First and latest timestamp; one that is too far ahead and not confirmed yet; whether a stored
    // background may be restored at the next reading.
    int64_t first_ns, last_ns, unconfirmed_ns, is_restorable, accepted;
    // Repetition: the latest reading, the length of the present run of equal ones, and how often a
    // reading was equal to the one before, or was not.
    double last[3];
    int64_t run;
    double repeats, changes;
    // Resolution: the latest value of each raw axis, since when it rests on it and for how many
    // readings, how often it stayed the same or changed, its smallest change, and the variance of
    // what the steps add; how many readings a decimated one is of.
    double raw[3];
    int64_t rest_since_ns[3], n_rest[3], n_same[3], n_changed[3];
    double step[3], step_variance[3], n_averaged;
    // Covariances of the messages: the latest standard deviations, and how many were overruled.
    double stated_std[3];
    int64_t n_overruled;
    // Spikes: the latest reading that passed, the differences before it, and the readings that are
    // held; of those `n_released` have passed and wait for their use.
    int64_t before_ns;
    double before[3];
    int64_t n_steps;
    double steps[RECENT][3];
    int64_t n_held, n_released, held_ns[MAX_HELD + 1];
    double held_field[MAX_HELD + 1][3], held_steps[MAX_HELD + 1][3];
    int64_t held_own[MAX_HELD + 1];
    double held_covariance[MAX_HELD + 1][3][3];
    // Blocks: length of a block, by which share the first is longer (NaN: blocks are not staggered,
    // and each is judged at once), when the present one ends, which of the two sums is collected,
    // and whether the other is complete.
    double length, phase, end;
    int64_t now, is_full;
    // Both sums, relative to their first reading; of each pair of axes, over the readings that have
    // both.
    int64_t n[2];
    double time[2], origin[2][3], count[2][3][3], sum[2][3][3], product[2][3][3];
};

}  // namespace mag_tracking
