// Motion models; sources.py cites the references.

#pragma once

#include <cmath>

#include "../arrays.hpp"

namespace mag_tracking {

// Angle below which the functions of a rotation are evaluated by their series [rad].
constexpr double SMALL_ANGLE = 1e-4;

// Writes the covariance of a double integrator driven by white noise of the given spectral density
// to the entries (level, rate) of Q (n, wide).
INLINE void integrator_noise(double* Q, int wide, int level, int rate, double density, double dt) {
    Q[level * wide + level] = density * dt * dt * dt / 3.0;
    Q[level * wide + rate] = Q[rate * wide + level] = density * dt * dt / 2.0;
    Q[rate * wide + rate] = density * dt;
}

// Motion over `dt` seconds along an arc. The horizontal velocity rotates at the turn rate, which is
// state number `w` [rad/s], anticlockwise seen from above. Relative to the initial turn rate, its
// mean over `dt` is `mean_factor` and its final value is `final_factor`.
//
// Bar-Shalom, Li and Kirubarajan 2001, Estimation with Applications to Tracking and Navigation,
// section 11.7.
INLINE void turn(const double* x, int w, double dt, double mean_factor, double final_factor,
                 Motion& out) {
    const double half = 0.5 * dt * mean_factor * x[w];
    // The angle between chord and velocity is half the turn angle. The chord is shorter than the arc.
    const double c = std::cos(half), s = std::sin(half);
    double chord = 1.0 - half * half / 6.0, slope = -half / 3.0;
    if (std::abs(half) > SMALL_ANGLE) chord = s / half, slope = (c - chord) / half;
    const double along_x = c * x[3] - s * x[4], along_y = s * x[3] + c * x[4];
    const double rotated_x = c * along_x - s * along_y, rotated_y = s * along_x + c * along_y;
    const double by_rate = 0.5 * dt * dt * mean_factor;
    const double cc = c * c - s * s, ss = 2.0 * s * c;
    out = Motion{
        6,
        4,
        {0, 1, 2, 3, 4, w},
        {{0, 3, 4, w}, {1, 3, 4, w}, {2, 5, 2, 2}, {3, 4, w, w}, {3, 4, w, w}, {w, w, w, w}},
        {{1.0, dt * chord * c, -dt * chord * s, by_rate * (slope * along_x - chord * along_y)},
         {1.0, dt * chord * s, dt * chord * c, by_rate * (slope * along_y + chord * along_x)},
         {1.0, dt},
         {cc, -ss, -dt * mean_factor * rotated_y},
         {ss, cc, dt * mean_factor * rotated_x},
         {final_factor}},
        {x[0] + dt * chord * along_x, x[1] + dt * chord * along_y, x[2] + dt * x[5], rotated_x,
         rotated_y, final_factor * x[w]}};
}

}  // namespace mag_tracking
