// Sensors with small mounting errors, as defined in dipole.py.

#pragma once

#include <cstddef>

#include "../arrays.hpp"
#include "../processors.hpp"

namespace mag_tracking {

// Rotates the field `h` (3) and derivative `H` (3, n_t) of a sensor by its mounting error `angles`
// (3) into out_h (3) and out_H (3, n_t + 3). The last columns are the derivative by the angles.
INLINE void rotated_field(const double* h, const double* H, const double* angles, std::size_t n_t,
                          double* out_h, double* out_H) {
    const double a0 = angles[0], a1 = angles[1], a2 = angles[2];
    const std::size_t n = n_t + 3;
    out_h[0] = h[0] + a1 * h[2] - a2 * h[1];
    out_h[1] = h[1] + a2 * h[0] - a0 * h[2];
    out_h[2] = h[2] + a0 * h[1] - a1 * h[0];
    double* __restrict out = out_H;
    for (std::size_t c = 0; c < n_t; ++c) {
        const double c0 = H[c], c1 = H[n_t + c], c2 = H[2 * n_t + c];
        out[c] = c0 + a1 * c2 - a2 * c1;
        out[n + c] = c1 + a2 * c0 - a0 * c2;
        out[2 * n + c] = c2 + a0 * c1 - a1 * c0;
    }
    // a x h = -[h]x a
    const double by_angles[3][3] = {{0.0, h[2], -h[1]}, {-h[2], 0.0, h[0]}, {h[1], -h[0], 0.0}};
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) out_H[i * n + n_t + k] = by_angles[i][k];
}

// Rotates the fields and derivatives of `n` sensors, as `rotated_field`.
FOR_PROCESSORS static void rotated_fields(const double* h, const double* H, const double* angles,
                                          std::size_t n, std::size_t n_t, double* out_h,
                                          double* out_H) {
    for (std::size_t i = 0; i < n; ++i)
        rotated_field(h + 3 * i, H + 3 * n_t * i, angles + 3 * i, n_t, out_h + 3 * i,
                      out_H + 3 * (n_t + 3) * i);
}

}  // namespace mag_tracking
