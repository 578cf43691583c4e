// Field of moving dipoles at fixed sensors, and its derivative by the target state.

#pragma once

#include <cstddef>

#include "dipole.hpp"
#include "../processors.hpp"

namespace mag_tracking {

// Dipoles of one hypothesis.
struct Cloud {
    std::size_t n, n_t;     // Dipoles; states.
    const double *r, *m;    // (n, 3) positions [m] and moments [A m^2], world frame.
    const double *dr, *dm;  // (n, 3, n_t) their derivatives by the state.
};

// Writes the field h (3) [T] and its derivative H (3, n_t) in the frame of a sensor at `position`
// (3); `R` (3, 3) rotates from the world to the sensor frame. Returns the gradient scale [T/m].
INLINE double sensor_field(const Cloud& cloud, const double* position, const double* R, double* h,
                           double* H) {
    const std::size_t n_t = cloud.n_t;
    double gradient = 0.0, field[3] = {0.0, 0.0, 0.0};
    for (std::size_t k = 0; k < 3 * n_t; ++k) H[k] = 0.0;
    for (std::size_t s = 0; s < cloud.n; ++s) {
        const double *r = cloud.r + 3 * s, *m = cloud.m + 3 * s;
        const double *dr = cloud.dr + 3 * s * n_t, *dm = cloud.dm + 3 * s * n_t;
        const Dipole dipole({position[0] - r[0], position[1] - r[1], position[2] - r[2]},
                            {m[0], m[1], m[2]});
        dipole.add_field(field);
        gradient += dipole.gradient();
        // Rotate to the sensor frame first: 3 x 3 products are cheaper than 3 x n_t.
        for (int i = 0; i < 3; ++i) {
            double g[3], q[3];
            dipole.rows(R + 3 * i, g, q);
            double* __restrict row = H + i * n_t;
            for (std::size_t c = 0; c < n_t; ++c)
                row[c] += q[0] * dm[c] + q[1] * dm[n_t + c] + q[2] * dm[2 * n_t + c] - g[0] * dr[c]
                          - g[1] * dr[n_t + c] - g[2] * dr[2 * n_t + c];
        }
    }
    for (int i = 0; i < 3; ++i)
        h[i] = R[3 * i] * field[0] + R[3 * i + 1] * field[1] + R[3 * i + 2] * field[2];
    return gradient;
}

// Evaluates `n` hypotheses at `n_sensors` sensors: h (n, n_sensors, 3), H (n, n_sensors, 3, n_t),
// gradient (n, n_sensors). The hypotheses are stored consecutively, beginning with `cloud`.
FOR_PROCESSORS static void set_sensor_fields(Cloud cloud, std::size_t n, const double* positions,
                                             const double* R_sw, std::size_t n_sensors, double* h,
                                             double* H, double* gradient) {
    const std::size_t size = 3 * cloud.n;
    for (std::size_t p = 0; p < n; ++p) {
        for (std::size_t j = 0; j < n_sensors; ++j, h += 3, H += 3 * cloud.n_t)
            *gradient++ = sensor_field(cloud, positions + 3 * j, R_sw + 9 * j, h, H);
        cloud.r += size, cloud.m += size;
        cloud.dr += size * cloud.n_t, cloud.dm += size * cloud.n_t;
    }
}

}  // namespace mag_tracking
