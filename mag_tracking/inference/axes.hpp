// Covariances of the three axes of a sensor, some of which may be missing (covariances.py).

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

namespace mag_tracking {

// Symmetric (3, 3) matrix: the lower triangle, row by row.
struct Symmetric {
    double s00, s10, s11, s20, s21, s22;
};

// Factors of S = L diag(e) L' with a unit lower triangular L.
struct Factors {
    double l10, l20, l21, e0, e1, e2;
};

// `C` (3, 3) with the rows and columns of missing axes (NaN in `y` (3)) replaced by identity.
inline Symmetric of_present_axes(const double* y, const double* C) {
    Symmetric s{C[0], C[3], C[4], C[6], C[7], C[8]};
    if (std::isnan(y[0])) s.s00 = 1.0, s.s10 = s.s20 = 0.0;
    if (std::isnan(y[1])) s.s11 = 1.0, s.s10 = s.s21 = 0.0;
    if (std::isnan(y[2])) s.s22 = 1.0, s.s20 = s.s21 = 0.0;
    return s;
}

inline Factors factors(const Symmetric& s) {
    Factors f;
    f.l10 = s.s10 / s.s00, f.l20 = s.s20 / s.s00;
    f.e0 = s.s00, f.e1 = s.s11 - f.l10 * s.s10;
    const double e21 = s.s21 - f.l20 * s.s10;
    f.l21 = e21 / f.e1;
    f.e2 = s.s22 - f.l20 * s.s20 - f.l21 * e21;
    return f;
}

// Computes y' C^-1 y over the measured axes, and their number. Returns false if C is not positive
// definite.
inline bool whitened_energy(const double* y, const double* C, double& energy,
                            std::int64_t& n_axes) {
    const Factors f = factors(of_present_axes(y, C));
    if (!(f.e0 > 0.0 && f.e1 > 0.0 && f.e2 > 0.0)) return false;
    double v[3];
    n_axes = 0;
    for (int a = 0; a < 3; ++a) {
        n_axes += !std::isnan(y[a]);
        v[a] = std::isnan(y[a]) ? 0.0 : y[a];
    }
    const double u1 = v[1] - f.l10 * v[0], u2 = v[2] - f.l20 * v[0] - f.l21 * u1;
    energy = v[0] * v[0] / f.e0 + u1 * u1 / f.e1 + u2 * u2 / f.e2;
    return true;
}

// Smallest pivot of the correlation matrix; NaN if the covariance is not finite or a variance is
// negative.
inline double smallest_pivot(const double* y, const double* C) {
    const Symmetric s = of_present_axes(y, C);
    // Scaled to unit diagonal, as every pivot is close to zero in squared tesla. A negative
    // variance becomes NaN.
    const double a = std::sqrt(s.s00), b = std::sqrt(s.s11), c = std::sqrt(s.s22);
    const Factors f = factors({s.s00 / (a * a), s.s10 / (a * b), s.s11 / (b * b), s.s20 / (a * c),
                               s.s21 / (b * c), s.s22 / (c * c)});
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            if (!std::isnan(y[i]) && !std::isnan(y[k]) && !std::isfinite(C[3 * i + k])) return NAN;
    return std::isfinite(f.e0 + f.e1 + f.e2) ? std::min(f.e0, std::min(f.e1, f.e2)) : NAN;
}

}  // namespace mag_tracking
