// Magnetic multipoles of orders 1 to 3; multipole.py defines the moments.
//
// All derivatives follow from grad P and grad grad P of the polynomial P of one order. Both are
// contractions of the moment tensor with d, and P = d.grad(P) / order.

#pragma once

#include <cmath>

#include "dipole.hpp"
#include "../processors.hpp"

namespace mag_tracking {

// Field and Jacobians of a source at one point; each order is added to the arrays.
struct Multipole {
    int k;                      // 3, 8 or 15 moments.
    double *B, *dB_dd, *dB_dm;  // (3) [T], (3, 3) [T/m], (3, k).
    double d[3], inv2;          // Sensor relative to the source [m]; 1 / |d|^2.

    // Adds one order, from grad P `g`, the upper triangle of grad grad P `H`, row by row, and
    // s = mu0/(4 pi) / |d|^(2 order + 1).
    INLINE void add_order(int order, double s, const double (&g)[3], const double (&H)[6]) const {
        const double a = (2 * order + 1) * s * inv2;
        const double e = a * (g[0] * d[0] + g[1] * d[1] + g[2] * d[2]) / order;
        const double f = (2 * order + 3) * e * inv2;
        for (int i = 0, n = 0; i < 3; ++i) {
            B[i] += e * d[i] - s * g[i];
            dB_dd[4 * i] += e;
            for (int j = i; j < 3; ++j, ++n) {
                const double J = a * (d[i] * g[j] + g[i] * d[j]) - f * d[i] * d[j] - s * H[n];
                dB_dd[3 * i + j] += J;
                if (j > i) dB_dd[3 * j + i] += J;
            }
        }
    }

    // Writes the columns of dB_dm from `first` on: the fields of unit components of one order, with
    // grad P in `gradients`.
    template <int n>
    INLINE void set_columns(int order, double s, const double (&gradients)[n][3], int first) const {
        const double a = (2 * order + 1) * s * inv2 / order;
        for (int c = 0; c < n; ++c) {
            const double* g = gradients[c];
            const double e = a * (g[0] * d[0] + g[1] * d[1] + g[2] * d[2]);
            for (int i = 0; i < 3; ++i) dB_dm[i * k + first + c] = e * d[i] - s * g[i];
        }
    }

    // Adds one order with grad P = `scale` H d.
    INLINE void add_order(int order, double s, double scale, const double (&H)[6]) const {
        add_order(order, s,
                  {scale * (H[0] * d[0] + H[1] * d[1] + H[2] * d[2]),
                   scale * (H[1] * d[0] + H[3] * d[1] + H[4] * d[2]),
                   scale * (H[2] * d[0] + H[4] * d[1] + H[5] * d[2])},
                  H);
    }

    INLINE void add_dipole(const double* m, double s) const {
        add_order(1, s, {m[0], m[1], m[2]}, {0.0, 0.0, 0.0, 0.0, 0.0, 0.0});
        set_columns(1, s, {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}}, 0);
    }

    // `m` (5): xx xy xz yy yz.
    INLINE void add_quadrupole(const double* m, double s) const {
        const double x = d[0], y = d[1], z = d[2];
        add_order(2, s, 1.0, {m[0], m[1], m[2], m[3], m[4], -m[0] - m[3]});
        set_columns(2, s, {{x, 0.0, -z}, {y, x, 0.0}, {z, 0.0, x}, {0.0, y, -z}, {0.0, z, y}}, 3);
    }

    // `m` (7): xxx xxy xxz xyy xyz yyy yyz.
    INLINE void add_octupole(const double* m, double s) const {
        const double x = d[0], y = d[1], z = d[2];
        const double xxx = m[0], xxy = m[1], xxz = m[2], xyy = m[3], xyz = m[4], yyy = m[5];
        const double yyz = m[6];
        const double H_xx = xxx * x + xxy * y + xxz * z, H_yy = xyy * x + yyy * y + yyz * z;
        add_order(3, s, 0.5,
                  {H_xx, xxy * x + xyy * y + xyz * z, xxz * x + xyz * y - (xxx + xyy) * z, H_yy,
                   xyz * x + yyz * y - (xxy + yyy) * z, -H_xx - H_yy});
        const double p = 0.5 * (x * x - z * z), q = 0.5 * (y * y - z * z);
        set_columns(3, s,
                    {{p, 0.0, -x * z},
                     {x * y, p, -y * z},
                     {x * z, 0.0, p},
                     {q, x * y, -x * z},
                     {y * z, x * z, x * y},
                     {0.0, q, -y * z},
                     {0.0, y * z, q}},
                    8);
    }
};

// Field and both Jacobians of one source with `k` moments `m` at one point, at `d` (3) [m] relative
// to the source. Overwrites B, dB_dd and dB_dm; all are NaN at d = 0.
//
// T10 eq. (3.39)-(3.41).
INLINE void multipole(const double* d, const double* m, int k, double* B, double* dB_dd,
                      double* dB_dm) {
    const double inv2 = 1.0 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    const double s = K_DIPOLE * inv2 * std::sqrt(inv2);
    for (int i = 0; i < 3; ++i) B[i] = 0.0;
    for (int i = 0; i < 9; ++i) dB_dd[i] = 0.0;
    const Multipole at{k, B, dB_dd, dB_dm, {d[0], d[1], d[2]}, inv2};
    at.add_dipole(m, s);
    if (k > 3) at.add_quadrupole(m + 3, s * inv2);
    if (k > 8) at.add_octupole(m + 8, s * inv2 * inv2);
}

// Evaluates `n` sources, as `multipole`.
FOR_PROCESSORS static void set_multipoles(const double* d, const double* m, std::size_t n, int k,
                                          double* B, double* dB_dd, double* dB_dm) {
    for (std::size_t i = 0; i < n; ++i)
        multipole(d + 3 * i, m + k * i, k, B + 3 * i, dB_dd + 9 * i, dB_dm + 3 * k * i);
}

}  // namespace mag_tracking
