// Passes with constant acceleration and turn acceleration; passes.py defines the parameters.

#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

#include "passes.hpp"

namespace mag_tracking {

// Parameters of the centre of the row at time zero; the clock offsets follow.
enum { X, Y, Z, SPEED, HEADING, CLIMB, LENGTH, ACCELERATION, TURN_RATE, TURN_ACCELERATION, N_PATH };
constexpr const char* PATH[N_PATH] = {"x",         "y",
                                      "z",         "speed",
                                      "heading",   "climb",
                                      "length",    "acceleration",
                                      "turn_rate", "turn_acceleration"};

// Gauss-Legendre nodes and weights for curved paths; the error is below a micrometre for turns of
// 90 degrees.
constexpr int N_NODES = 6;
constexpr double NODES[N_NODES] = {-0.93246951420315202781, -0.66120938646626451366,
                                   -0.23861918608319690863, 0.23861918608319690863,
                                   0.66120938646626451366,  0.93246951420315202781};
constexpr double WEIGHTS[N_NODES] = {0.17132449237917034504, 0.36076157304813860757,
                                     0.46791393457269104739, 0.46791393457269104739,
                                     0.36076157304813860757, 0.17132449237917034504};

// Centre of the row at one time.
struct Middle {
    double position[3], heading;  // [m], [rad]
    double time;                  // [s], reference clock. A clock that is ahead stamps too late.

    // `clock` is the clock of the sample; -1: reference clock.
    INLINE Middle(const double* theta, double t, long clock) {
        time = clock >= 0 ? t - theta[N_PATH + clock] : t;
        const double v = theta[SPEED], gain = theta[ACCELERATION];
        const double rate = theta[TURN_RATE], more = theta[TURN_ACCELERATION];
        position[0] = theta[X], position[1] = theta[Y];
        position[2] = theta[Z] + theta[CLIMB] * time;
        heading = theta[HEADING] + (rate + 0.5 * more * time) * time;
        if (rate == 0.0 && more == 0.0) {
            const double way = (v + 0.5 * gain * time) * time;
            position[0] += way * std::cos(theta[HEADING]);
            position[1] += way * std::sin(theta[HEADING]);
            return;
        }
        for (int g = 0; g < N_NODES; ++g) {
            const double at = 0.5 * time * (NODES[g] + 1.0);
            const double way = 0.5 * time * WEIGHTS[g] * (v + gain * at);
            const double angle = theta[HEADING] + (rate + 0.5 * more * at) * at;
            position[0] += way * std::cos(angle);
            position[1] += way * std::sin(angle);
        }
    }

    // Writes the derivatives of position and heading by the `n` parameters to `by` (4, n).
    INLINE void derivative(const double* theta, long clock, int n, double* by) const {
        const double v = theta[SPEED], gain = theta[ACCELERATION];
        const double rate = theta[TURN_RATE], more = theta[TURN_ACCELERATION];
        const bool bends = rate != 0.0 || more != 0.0;
        const double cos_0 = std::cos(theta[HEADING]), sin_0 = std::sin(theta[HEADING]);
        double *x = by, *y = by + n, *z = by + 2 * n, *heading_by = by + 3 * n;
        for (int k = 0; k < 4 * n; ++k) by[k] = 0.0;
        x[X] = y[Y] = z[Z] = 1.0, z[CLIMB] = time;
        for (int g = 0; g < N_NODES; ++g) {
            const double at = 0.5 * time * (NODES[g] + 1.0), step = 0.5 * time * WEIGHTS[g];
            const double angle = theta[HEADING] + (rate + 0.5 * more * at) * at;
            const double c = step * (bends ? std::cos(angle) : cos_0);
            const double s = step * (bends ? std::sin(angle) : sin_0);
            const double way = v + gain * at;
            x[SPEED] += c, y[SPEED] += s;
            x[ACCELERATION] += at * c, y[ACCELERATION] += at * s;
            x[HEADING] -= way * s, y[HEADING] += way * c;
            x[TURN_RATE] -= at * way * s, y[TURN_RATE] += at * way * c;
            x[TURN_ACCELERATION] -= 0.5 * at * at * way * s;
            y[TURN_ACCELERATION] += 0.5 * at * at * way * c;
        }
        heading_by[HEADING] = 1.0, heading_by[TURN_RATE] = time;
        heading_by[TURN_ACCELERATION] = 0.5 * time * time;
        if (clock < 0) return;
        const double now = v + gain * time;
        const int k = N_PATH + int(clock);
        x[k] = -now * std::cos(heading), y[k] = -now * std::sin(heading), z[k] = -theta[CLIMB];
        heading_by[k] = -rate - more * time;
    }
};

// Writes the fields of unit moments at sample s to A (3, 3 d), for path and clock offsets `theta`.
INLINE void steady_basis(const double* theta, const Row& row, const Samples& samples, long s,
                         long clock, double* A) {
    const Middle at(theta, samples.t[s], clock);
    const double u_x = std::cos(at.heading), u_y = std::sin(at.heading);
    const double* p = samples.positions + 3 * s;
    for (int i = 0; i < row.n; ++i) {
        const double q = row.offsets[i] * theta[LENGTH];
        set_unit_fields({p[0] - at.position[0] - q * u_x, p[1] - at.position[1] - q * u_y,
                         p[2] - at.position[2]},
                        samples.M + 9 * s, A + 3 * i, 3 * row.n);
    }
}

// Writes the derivative by theta (n) of the field of `moments` (d, 3) to D (3, n). `by` (4, n) is
// overwritten.
INLINE void steady_derivative(const double* theta, int n, const double* moments, const Row& row,
                              const Samples& samples, long s, long clock, double* by, double* D) {
    const Middle at(theta, samples.t[s], clock);
    at.derivative(theta, clock, n, by);
    const double u_x = std::cos(at.heading), u_y = std::sin(at.heading);
    const double *p = samples.positions + 3 * s, *M = samples.M + 9 * s;
    double by_place[3][3] = {}, by_heading[3] = {}, by_length[3] = {};
    for (int i = 0; i < row.n; ++i) {
        const double q = row.offsets[i] * theta[LENGTH];
        const double* m = moments + 3 * i;
        const Dipole dipole({p[0] - at.position[0] - q * u_x, p[1] - at.position[1] - q * u_y,
                             p[2] - at.position[2]},
                            {m[0], m[1], m[2]});
        for (int a = 0; a < 3; ++a) {
            double g[3], by_moment[3];
            dipole.rows(M + 3 * a, g, by_moment);
            for (int b = 0; b < 3; ++b) by_place[a][b] -= g[b];
            by_heading[a] -= q * (g[1] * u_x - g[0] * u_y);
            by_length[a] -= row.offsets[i] * (g[0] * u_x + g[1] * u_y);
        }
    }
    for (int a = 0; a < 3; ++a) {
        double* __restrict row_of_D = D + a * n;
        for (int c = 0; c < n; ++c)
            row_of_D[c] = by_place[a][0] * by[c] + by_place[a][1] * by[n + c]
                          + by_place[a][2] * by[2 * n + c] + by_heading[a] * by[3 * n + c];
        row_of_D[LENGTH] += by_length[a];
    }
}

// Writes the design matrices of `n` paths theta (n, n_theta) to A (n, 3 n_samples, 3 d).
[[maybe_unused]]
FOR_PROCESSORS static void set_steady_bases(const double* theta, long n, int n_theta,
                                            const Row& row, const Samples& samples,
                                            const std::int64_t* clocks, double* A) {
    for (long p = 0; p < n; ++p)
        for (long s = 0; s < samples.n; ++s, A += 9 * row.n)
            steady_basis(theta + p * n_theta, row, samples, s, long(clocks[s]), A);
}

// Writes the derivatives by theta for the moments (n, 3 d) to D (n, 3 n_samples, n_theta).
[[maybe_unused]]
FOR_PROCESSORS static void set_steady_derivatives(
    const double* theta, const double* moments, long n, int n_theta, const Row& row,
    const Samples& samples, const std::int64_t* clocks, double* D) {
    std::vector<double> by(4 * std::size_t(n_theta));
    for (long p = 0; p < n; ++p)
        for (long s = 0; s < samples.n; ++s, D += 3 * n_theta)
            steady_derivative(theta + p * n_theta, n_theta, moments + 3 * p * row.n, row, samples,
                              s, long(clocks[s]), by.data(), D);
}

}  // namespace mag_tracking
