// Straight passes at constant velocity; passes.py defines the parameters.

#pragma once

#include <cmath>

#include "dipole.hpp"
#include "../processors.hpp"

namespace mag_tracking {

// Samples of a pass.
struct Samples {
    long n;
    const double *t, *positions, *M;  // As in passes.py.
};

// Dipoles of a row, from tail to head.
struct Row {
    int n;
    const double* offsets;  // (n) positions along the row, in row lengths from the centre.
};

// A row on a straight path with parameters `theta`: 6, or 7 for two or more dipoles.
//
// TSP14 eq. (18)-(21).
class StraightPath {
  public:
    INLINE StraightPath(const double* theta, const Row& row) : row_(row) {
        for (int a = 0; a < 3; ++a) r_[a] = theta[a], v_[a] = theta[3 + a];
        slowness_ = 1.0 / std::sqrt(v_[0] * v_[0] + v_[1] * v_[1] + v_[2] * v_[2]);
        for (int a = 0; a < 3; ++a) u_[a] = v_[a] * slowness_;
        length_ = row.n > 1 ? theta[6] : 0.0;
        stretch_ = row.n > 1 ? theta[6] * slowness_ : 0.0;
    }

    // Writes the fields of unit moments at sample s to A (3, 3 d).
    INLINE void basis(const Samples& samples, long s, double* A) const {
        const double *position = samples.positions + 3 * s, *M = samples.M + 9 * s;
        for (int i = 0; i < row_.n; ++i) {
            const double ahead = samples.t[s] + row_.offsets[i] * stretch_;
            double d[3];
            for (int a = 0; a < 3; ++a) d[a] = position[a] - r_[a] - ahead * v_[a];
            set_unit_fields(d, M, A + 3 * i, 3 * row_.n);
        }
    }

    // Writes the derivative by theta of the field of `moments` (d, 3) at sample s to D
    // (3, n_theta).
    INLINE void derivative(const Samples& samples, long s, const double* moments, double* D) const {
        const double *position = samples.positions + 3 * s, *M = samples.M + 9 * s;
        const double t = samples.t[s];
        double by_place[3][3] = {}, by_turn[3][3] = {}, by_length[3] = {};
        for (int i = 0; i < row_.n; ++i) {
            const double ahead = row_.offsets[i] * length_;
            double d[3];
            for (int a = 0; a < 3; ++a) d[a] = position[a] - r_[a] - t * v_[a] - ahead * u_[a];
            const double* m = moments + 3 * i;
            const Dipole dipole(d, {m[0], m[1], m[2]});
            for (int a = 0; a < 3; ++a) {
                double g[3], by_moment[3];
                dipole.rows(M + 3 * a, g, by_moment);
                for (int b = 0; b < 3; ++b) by_place[a][b] -= g[b];
                if (row_.n == 1) continue;
                // The row rotates with v: d(u)/dv = (I - uu')/|v|.
                const double turn = ahead * slowness_;
                const double along = -(g[0] * u_[0] + g[1] * u_[1] + g[2] * u_[2]);
                for (int b = 0; b < 3; ++b) by_turn[a][b] -= turn * (g[b] + along * u_[b]);
                by_length[a] += row_.offsets[i] * along;
            }
        }
        for (int a = 0; a < 3; ++a) {
            for (int b = 0; b < 3; ++b) *D++ = by_place[a][b];
            for (int b = 0; b < 3; ++b) *D++ = t * by_place[a][b] + by_turn[a][b];
            if (row_.n > 1) *D++ = by_length[a];
        }
    }

  private:
    Row row_;
    double r_[3], v_[3], u_[3], slowness_, length_, stretch_;
};

// Writes the design matrices of `n` paths theta (n, n_theta) to A (n, 3 n_samples, 3 d).
[[maybe_unused]]
FOR_PROCESSORS static void set_row_bases(const double* theta, long n, int n_theta, const Row& row,
                                         const Samples& samples, double* A) {
    for (long p = 0; p < n; ++p) {
        const StraightPath path(theta + p * n_theta, row);
        for (long s = 0; s < samples.n; ++s, A += 9 * row.n) path.basis(samples, s, A);
    }
}

// Writes the derivatives by theta for the moments (n, 3 d) to D (n, 3 n_samples, n_theta).
[[maybe_unused]]
FOR_PROCESSORS static void set_row_derivatives(const double* theta, const double* moments, long n,
                                               int n_theta, const Row& row, const Samples& samples,
                                               double* D) {
    for (long p = 0; p < n; ++p) {
        const StraightPath path(theta + p * n_theta, row);
        for (long s = 0; s < samples.n; ++s, D += 3 * n_theta)
            path.derivative(samples, s, moments + 3 * p * row.n, D);
    }
}

}  // namespace mag_tracking
