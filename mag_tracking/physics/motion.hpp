// Motion models; motion.py has the sources of the equations.

#pragma once

#include <cmath>

#include "../arrays.hpp"

namespace mag_tracking {

// [rad] Below it what a turn does is taken from its series.
constexpr double SMALL_ANGLE = 1e-4;

// White noise of the spectral density `density` that is integrated twice, into `Q` (n, wide).
INLINE void integrator_noise(double* Q, int wide, int level, int rate, double density, double dt) {
    Q[level * wide + level] = density * dt * dt * dt / 3.0;
    Q[level * wide + rate] = Q[rate * wide + level] = density * dt * dt / 2.0;
    Q[rate * wide + rate] = density * dt;
}

// A move of `dt` seconds along an arc. The horizontal velocity turns at the rate that is state
// `w` [rad/s], anticlockwise seen from above; over that time its mean is `mean` times that at the
// beginning, and that at the end `fading` times.
//
// Source: Bar-Shalom, Li and Kirubarajan 2001, Estimation with Applications to Tracking and
// Navigation, section 11.7.
INLINE void turn(const double* x, int w, double dt, double mean, double fading, Motion& out) {
    const double half = 0.5 * dt * mean * x[w];
    // The chord of the arc: half the angle off the velocity, and a little shorter than the way.
    const double c = std::cos(half), s = std::sin(half);
    double chord = 1.0 - half * half / 6.0, slope = -half / 3.0;
    if (std::abs(half) > SMALL_ANGLE) chord = s / half, slope = (c - chord) / half;
    const double along_x = c * x[3] - s * x[4], along_y = s * x[3] + c * x[4];
    const double turned_x = c * along_x - s * along_y, turned_y = s * along_x + c * along_y;
    const double by_rate = 0.5 * dt * dt * mean;
    const double cc = c * c - s * s, ss = 2.0 * s * c;
    out = Motion{
        6, 4, {0, 1, 2, 3, 4, w},
        {{0, 3, 4, w}, {1, 3, 4, w}, {2, 5, 2, 2}, {3, 4, w, w}, {3, 4, w, w}, {w, w, w, w}},
        {{1.0, dt * chord * c, -dt * chord * s, by_rate * (slope * along_x - chord * along_y)},
         {1.0, dt * chord * s, dt * chord * c, by_rate * (slope * along_y + chord * along_x)},
         {1.0, dt},
         {cc, -ss, -dt * mean * turned_y},
         {ss, cc, dt * mean * turned_x},
         {fading}},
        {x[0] + dt * chord * along_x, x[1] + dt * chord * along_y, x[2] + dt * x[5], turned_x,
         turned_y, fading * x[w]}};
}

}  // namespace mag_tracking
