// The magnetic dipole: flux density and derivatives.

#pragma once

#include <cmath>

#include "../arrays.hpp"

namespace mag_tracking {

constexpr double K_DIPOLE = 1e-7;  // mu0 / (4 pi) [T m/A]

// Field and derivatives of one dipole, TSP14 eq. (2), (30a), (30b), with the factor mu0 / (4 pi).
// All are NaN at d = 0.
struct Dipole {
    double d[3], m[3], inv2, k3, b, e, g;

    // `d_` [m] is the position of the sensor relative to the dipole, `m_` the moment [A m^2].
    INLINE Dipole(const double (&d_)[3], const double (&m_)[3]) {
        for (int a = 0; a < 3; ++a) d[a] = d_[a], m[a] = m_[a];
        inv2 = 1.0 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        k3 = K_DIPOLE * inv2 * std::sqrt(inv2);
        b = 3.0 * k3 * inv2;
        e = b * (d[0] * m[0] + d[1] * m[1] + d[2] * m[2]);
        g = 5.0 * e * inv2;
    }

    INLINE void add_field(double* field) const {
        for (int a = 0; a < 3; ++a) field[a] += e * d[a] - k3 * m[a];
    }

    // dB/dd [T/m] and dB/dm [T/(A m^2)], (3, 3) each; both are symmetric.
    INLINE void jacobians(double* by_place, double* by_moment) const {
        for (int i = 0; i < 3; ++i)
            for (int k = i; k < 3; ++k) {
                const double place = b * (d[i] * m[k] + d[k] * m[i]) - g * d[i] * d[k];
                const double moment = b * d[i] * d[k];
                by_place[3 * i + k] = by_place[3 * k + i] = i == k ? place + e : place;
                by_moment[3 * i + k] = by_moment[3 * k + i] = i == k ? moment - k3 : moment;
            }
    }

    // Row `R` (3) times dB/dd and dB/dm.
    INLINE void rows(const double* R, double (&by_place)[3], double (&by_moment)[3]) const {
        const double ud = R[0] * d[0] + R[1] * d[1] + R[2] * d[2];
        const double um = R[0] * m[0] + R[1] * m[1] + R[2] * m[2];
        const double t = b * um - g * ud;
        for (int a = 0; a < 3; ++a) {
            by_place[a] = t * d[a] + b * ud * m[a] + e * R[a];
            by_moment[a] = b * ud * d[a] - k3 * R[a];
        }
    }

    // Field gradient scale mu0/(4 pi) |m| / |d|^4 [T/m].
    INLINE double gradient() const {
        return K_DIPOLE * std::sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2]) * inv2 * inv2;
    }
};

// Writes the field of unit moments at `d`, multiplied by M (3, 3), to 3 columns of A (3, stride).
INLINE void set_unit_fields(const double (&d)[3], const double* M, double* A, int stride) {
    const Dipole dipole(d, {0.0, 0.0, 0.0});
    for (int a = 0; a < 3; ++a) {
        double by_place[3], by_moment[3];
        dipole.rows(M + 3 * a, by_place, by_moment);
        for (int b = 0; b < 3; ++b) A[a * stride + b] = by_moment[b];
    }
}

}  // namespace mag_tracking
