// Vehicle models: a point target or a row of dipoles along the heading, for one state at a time.

#pragma once

#include <algorithm>
#include <cmath>

#include "dipole.hpp"
#include "motion.hpp"

namespace mag_tracking {

// Squared magnitude of the iron of a state [A^2 m^4]: hard iron moment, plus soft iron times
// |B0/mu0| per axis. `field_strength2` is |B0/mu0|^2 [A^2/m^2].
INLINE double iron_size2(const double* x, int n_dipoles, double field_strength2) {
    const int soft = 6 + 3 * n_dipoles;
    double size2 = 0.0;
    for (int a = 0; a < 3; ++a) {
        double moment = 0.0;
        for (int k = 6 + a; k < soft; k += 3) moment += x[k];
        size2 += moment * moment + x[soft + a] * x[soft + a] * field_strength2 / 3.0;
    }
    return size2;
}

// Heading of a state, and the moment induced by the earth's field in each of its dipoles.
struct Induced {
    double slowness;  // [s/m]; 0 at zero speed, where the derivative of the heading is set to 0.
    double c, s;      // Cosine and sine of the heading.
    double ahead, left, up;  // [A/m] B0/mu0 over the number of dipoles, vehicle frame.
    double x, y;             // [A m^2] horizontal induced moment, world frame.
    double by_x, by_y;       // Its derivative by the heading.

    INLINE Induced(const double* state, int n_dipoles, const double* field_strength) {
        const double* v = state + 3;
        const double* soft = state + 6 + 3 * n_dipoles;
        const double speed = std::sqrt(v[0] * v[0] + v[1] * v[1]);
        slowness = speed > 0.0 ? 1.0 / speed : 0.0;
        c = speed > 0.0 ? v[0] * slowness : 1.0, s = v[1] * slowness;
        const double h_x = field_strength[0] / n_dipoles, h_y = field_strength[1] / n_dipoles;
        ahead = c * h_x + s * h_y, left = c * h_y - s * h_x, up = field_strength[2] / n_dipoles;
        const double m_ahead = soft[0] * ahead, m_left = soft[1] * left;
        // In the frame of a body that rotates anticlockwise, the field rotates clockwise.
        const double dm_ahead = soft[0] * left - m_left, dm_left = m_ahead - soft[1] * ahead;
        x = c * m_ahead - s * m_left, y = s * m_ahead + c * m_left;
        by_x = c * dm_ahead - s * dm_left, by_y = s * dm_ahead + c * dm_left;
    }
};

// A row of dipoles along the heading: RowVehicle of vehicles.py.
struct RowVehicle {
    int n_states, n_dipoles;
    double density[3], field_strength[3];  // Acceleration density [m^2/s^3]; B0/mu0 [A/m].
    double moment_drift, difference_drift, turn_acceleration, turn_time, max_turn_rate;

    INLINE int n() const { return n_states; }

    // Position of dipole i along the row, in row lengths from the centre.
    INLINE double place_of(int i) const {
        return n_dipoles > 1 ? double(i) / (n_dipoles - 1) - 0.5 : 0.0;
    }

    INLINE void move(const double* x, double dt, Motion& out) const {
        if (turn_acceleration == 0.0) {
            out.n = 3, out.width = 2;
            for (int a = 0; a < 3; ++a) {
                out.rows[a] = out.columns[a][0] = a, out.columns[a][1] = 3 + a;
                out.f[a][0] = 1.0, out.f[a][1] = dt;
                out.moved[a] = x[a] + dt * x[3 + a];
            }
            return;
        }
        const int w = n_states - 1;
        // No decay in backward propagation, which has no process noise: the variance would shrink.
        const double final_factor = std::exp(-std::max(dt, 0.0) / turn_time);
        const double mean_factor = dt > 0.0 ? (1.0 - final_factor) * turn_time / dt : 1.0;
        turn(x, w, dt, mean_factor, final_factor, out);
    }

    // Writes the process noise of a prediction by dt > 0 seconds, from state `x` with covariance
    // `P` (n_x, wide), to the non-zero entries of `Q` (n, wide).
    INLINE void noise(const double* x, const double* P, int wide, double dt, const Motion&,
                      double* Q) const {
        const int n = n_states, d = n_dipoles;
        for (int a = 0; a < 3; ++a) integrator_noise(Q, wide, a, 3 + a, density[a], dt);
        double field_strength2 = 0.0;
        for (int a = 0; a < 3; ++a) field_strength2 += field_strength[a] * field_strength[a];
        const double size2 = iron_size2(x, d, field_strength2);
        const double whole = dt * size2 * moment_drift * moment_drift / d;
        const double difference = dt * size2 * difference_drift * difference_drift;
        const double between = (whole - difference) / d;
        for (int i = 0; i < d; ++i)
            for (int k = 0; k < d; ++k)
                for (int a = 0; a < 3; ++a)
                    Q[(6 + 3 * i + a) * wide + 6 + 3 * k + a] =
                        between + (i == k ? difference : 0.0);
        if (turn_acceleration == 0.0) return;
        // A turn rate of zero variance has no noise: the path remains straight.
        const int w = n - 1;
        const double final_factor = std::exp(-dt / turn_time);
        const double speed = std::max(std::sqrt(x[3] * x[3] + x[4] * x[4]),
                                      turn_acceleration / max_turn_rate);
        const double rate = turn_acceleration / speed;
        Q[w * wide + w] = P[w * wide + w] > 0.0 ? (1.0 - final_factor * final_factor) * rate * rate
                                                : 0.0;
    }

    // Positions and moments (d, 3) of the dipoles, TSP14 eq. (10b) and ICASSP11 eq. (8), and their
    // derivatives (d, 3, n) by the state, which must be zero on entry.
    INLINE void dipoles(const double* x, double* r, double* m, double* dr, double* dm) const {
        const int n = n_states, d = n_dipoles, soft = 6 + 3 * d, length = 9 + 3 * d;
        const Induced iron(x, d, field_strength);
        const double c = iron.c, s = iron.s;
        // d(heading)/dv = [-sin, cos]/|v|
        const double turn_x = -s * iron.slowness, turn_y = c * iron.slowness;
        for (int i = 0; i < d; ++i, r += 3, m += 3, dr += 3 * n, dm += 3 * n) {
            const int k = 6 + 3 * i;
            const double hard_x = c * x[k] - s * x[k + 1], hard_y = s * x[k] + c * x[k + 1];
            m[0] = hard_x + iron.x, m[1] = hard_y + iron.y;
            m[2] = x[k + 2] + iron.up * x[soft + 2];
            dm[k] = c, dm[k + 1] = -s;
            dm[n + k] = s, dm[n + k + 1] = c;
            dm[2 * n + k + 2] = 1.0;
            // d(hard)/d(heading) = z x hard
            const double slope_x = iron.by_x - hard_y, slope_y = iron.by_y + hard_x;
            dm[3] = slope_x * turn_x, dm[4] = slope_x * turn_y;
            dm[n + 3] = slope_y * turn_x, dm[n + 4] = slope_y * turn_y;
            dm[soft] = c * iron.ahead, dm[soft + 1] = -s * iron.left;
            dm[n + soft] = s * iron.ahead, dm[n + soft + 1] = c * iron.left;
            dm[2 * n + soft + 2] = iron.up;
            for (int a = 0; a < 3; ++a) r[a] = x[a], dr[a * n + a] = 1.0;
            if (d == 1) continue;
            const double place = place_of(i), along = place * x[length];
            r[0] += along * c, r[1] += along * s;
            dr[length] = place * c, dr[n + length] = place * s;
            dr[3] = -along * s * turn_x, dr[4] = -along * s * turn_y;
            dr[n + 3] = along * c * turn_x, dr[n + 4] = along * c * turn_y;
        }
    }

    // Field at `position` (3) [m]. `field` (3) [T] is in the world frame; `R` (3, 3) rotates from
    // the world frame to that of the derivative `H` (3, stride), of which the first n columns are
    // written. Returns the gradient [T/m] as defined in dipole.sensor_fields.
    INLINE double field(const double* x, const double* position, const double* R, double* field,
                        double* H, int stride) const {
        const int d = n_dipoles, soft = 6 + 3 * d, length = 9 + 3 * d;
        const Induced iron(x, d, field_strength);
        const double c = iron.c, s = iron.s;
        for (int a = 0; a < 3; ++a) {
            field[a] = 0.0;
            for (int i = 0; i < n_states; ++i) H[a * stride + i] = 0.0;
        }
        double gradient = 0.0, by_heading[3] = {0.0, 0.0, 0.0};
        for (int i = 0; i < d; ++i) {
            const int k = 6 + 3 * i;
            const double place = place_of(i), along = d > 1 ? place * x[length] : 0.0;
            const double hard_x = c * x[k] - s * x[k + 1], hard_y = s * x[k] + c * x[k + 1];
            const Dipole dipole({position[0] - x[0] - along * c, position[1] - x[1] - along * s,
                                 position[2] - x[2]},
                                {hard_x + iron.x, hard_y + iron.y,
                                 x[k + 2] + iron.up * x[soft + 2]});
            dipole.add_field(field);
            gradient += dipole.gradient();
            // d(hard)/d(heading) = z x hard; d(position)/d(heading) = along z x heading.
            const double slope_x = iron.by_x - hard_y, slope_y = iron.by_y + hard_x;
            for (int a = 0; a < 3; ++a) {
                double g[3], q[3], *row = H + a * stride;
                dipole.rows(R + 3 * a, g, q);
                const double q_ahead = c * q[0] + s * q[1], q_left = c * q[1] - s * q[0];
                for (int b = 0; b < 3; ++b) row[b] -= g[b];
                row[k] = q_ahead, row[k + 1] = q_left, row[k + 2] = q[2];
                row[soft] += iron.ahead * q_ahead;
                row[soft + 1] += iron.left * q_left;
                row[soft + 2] += iron.up * q[2];
                by_heading[a] += q[0] * slope_x + q[1] * slope_y + along * (g[0] * s - g[1] * c);
                if (d > 1) row[length] -= place * (g[0] * c + g[1] * s);
            }
        }
        for (int a = 0; a < 3; ++a) {
            // d(heading)/dv = [-sin, cos]/|v|
            H[a * stride + 3] = -s * iron.slowness * by_heading[a];
            H[a * stride + 4] = c * iron.slowness * by_heading[a];
        }
        return gradient;
    }
};

}  // namespace mag_tracking
