// The target models of vehicles.py and sources.py, for one state at a time.
//
// RowVehicle and Magnet of Python say what the states are and have the sources of the equations;
// the tests compare both. A model moves a state (`move`), has the process noise of that (`noise`),
// and the field at one sensor with its derivative (`field`).

#pragma once

#include <algorithm>
#include <cmath>

#include "../arrays.hpp"

namespace mag_tracking {

constexpr double K_DIPOLE = 1e-7;     // mu0 / 4 pi [T m / A]
constexpr double SMALL_ANGLE = 1e-4;  // [rad] Below it what a turn does is taken from its series.

// Field and derivatives of one dipole, TSP14 eq. (2), (30a), (30b), as rows of a turned frame.
struct Dipole {
    double d[3], m[3], inv2, k3, b, e, g;

    // `d_` [m] from the dipole to the sensor, `m_` its moment [A m^2].
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

    // Row `R` (3) times dB/dd, and times dB/dm; both are symmetric.
    INLINE void rows(const double* R, double (&by_place)[3], double (&by_moment)[3]) const {
        const double ud = R[0] * d[0] + R[1] * d[1] + R[2] * d[2];
        const double um = R[0] * m[0] + R[1] * m[1] + R[2] * m[2];
        const double t = b * um - g * ud;
        for (int a = 0; a < 3; ++a) {
            by_place[a] = t * d[a] + b * ud * m[a] + e * R[a];
            by_moment[a] = b * ud * d[a] - k3 * R[a];
        }
    }

    // [T/m] mu0/4pi |m| / |d|^4.
    INLINE double gradient() const {
        return K_DIPOLE * std::sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2]) * inv2 * inv2;
    }
};

// White noise of the spectral density `density` that is integrated twice, into `Q` (n, wide).
INLINE void integrator_noise(double* Q, int wide, int level, int rate, double density, double dt) {
    Q[level * wide + level] = density * dt * dt * dt / 3.0;
    Q[level * wide + rate] = Q[rate * wide + level] = density * dt * dt / 2.0;
    Q[rate * wide + rate] = density * dt;
}

// A row of dipoles along the heading: RowVehicle of vehicles.py.
struct RowVehicle {
    int n_states, n_dipoles;
    double density[3], induction[3];  // Of the acceleration [m^2/s^3]; B0/mu0 [A/m].
    double moment_drift, difference_drift, turn_acceleration, turn_time, fastest_turn;

    INLINE int n() const { return n_states; }

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
        // Backwards, without noise, nothing may become surer than it is.
        const double fading = std::exp(-std::max(dt, 0.0) / turn_time);
        const double mean = dt > 0.0 ? (1.0 - fading) * turn_time / dt : 1.0;
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

    // Of dt > 0 seconds from the state `x` with the covariance `P` (n_x, wide) on, into `Q` (n,
    // wide); only what is not zero.
    INLINE void noise(const double* x, const double* P, int wide, double dt, const Motion&,
                      double* Q) const {
        const int n = n_states, d = n_dipoles, soft = 6 + 3 * d;
        for (int a = 0; a < 3; ++a) integrator_noise(Q, wide, a, 3 + a, density[a], dt);
        double size2 = 0.0, induction2 = 0.0;
        for (int a = 0; a < 3; ++a) induction2 += induction[a] * induction[a];
        for (int a = 0; a < 3; ++a) {
            double moment = 0.0;
            for (int k = 6 + a; k < soft; k += 3) moment += x[k];
            size2 += moment * moment + x[soft + a] * x[soft + a] * induction2 / 3.0;
        }
        const double whole = dt * size2 * moment_drift * moment_drift / d;
        const double difference = dt * size2 * difference_drift * difference_drift;
        const double between = (whole - difference) / d;
        for (int i = 0; i < d; ++i)
            for (int k = 0; k < d; ++k)
                for (int a = 0; a < 3; ++a)
                    Q[(6 + 3 * i + a) * wide + 6 + 3 * k + a] = between + (i == k ? difference : 0.0);
        if (turn_acceleration == 0.0) return;
        // A turn rate whose variance is zero gets no noise: such a vehicle goes straight on.
        const int w = n - 1;
        const double fading = std::exp(-dt / turn_time);
        const double speed = std::max(std::sqrt(x[3] * x[3] + x[4] * x[4]),
                                      turn_acceleration / fastest_turn);
        const double rate = turn_acceleration / speed;
        Q[w * wide + w] = P[w * wide + w] > 0.0 ? (1.0 - fading * fading) * rate * rate : 0.0;
    }

    // At `position` (3) [m]; `R` (3, 3) turns from the world to the frame of the derivative `H`
    // (3, stride), of which the first n columns are written. `field` (3) [T] is in the world.
    // Returns the size of the gradient [T/m] as dipole.sensor_fields has it.
    INLINE double field(const double* x, const double* position, const double* R, double* field,
                        double* H, int stride) const {
        const int d = n_dipoles, soft = 6 + 3 * d, length = 9 + 3 * d;
        const double speed = std::sqrt(x[3] * x[3] + x[4] * x[4]);
        const double slowness = speed > 0.0 ? 1.0 / speed : 0.0;
        const double c = speed > 0.0 ? x[3] * slowness : 1.0, s = x[4] * slowness;
        const double h_x = induction[0] / d, h_y = induction[1] / d, h_z = induction[2] / d;
        // The earth's field ahead of the vehicle and to its left, and what it induces.
        const double ahead = c * h_x + s * h_y, left = c * h_y - s * h_x;
        const double m_ahead = x[soft] * ahead, m_left = x[soft + 1] * left;
        const double dm_ahead = x[soft] * left - m_left, dm_left = m_ahead - x[soft + 1] * ahead;
        const double soft_x = c * m_ahead - s * m_left, soft_y = s * m_ahead + c * m_left;
        const double by_x = c * dm_ahead - s * dm_left, by_y = s * dm_ahead + c * dm_left;
        for (int a = 0; a < 3; ++a) {
            field[a] = 0.0;
            for (int i = 0; i < n_states; ++i) H[a * stride + i] = 0.0;
        }
        double gradient = 0.0, by_heading[3] = {0.0, 0.0, 0.0};
        for (int i = 0; i < d; ++i) {
            const int k = 6 + 3 * i;
            const double place = d > 1 ? double(i) / (d - 1) - 0.5 : 0.0;
            const double along = d > 1 ? place * x[length] : 0.0;
            const double hard_x = c * x[k] - s * x[k + 1], hard_y = s * x[k] + c * x[k + 1];
            const Dipole dipole({position[0] - x[0] - along * c, position[1] - x[1] - along * s,
                                 position[2] - x[2]},
                                {hard_x + soft_x, hard_y + soft_y,
                                 x[k + 2] + h_z * x[soft + 2]});
            dipole.add_field(field);
            gradient += dipole.gradient();
            // d(hard)/d(heading) = z x hard; of the place it is along z x heading.
            const double turned_x = by_x - hard_y, turned_y = by_y + hard_x;
            for (int a = 0; a < 3; ++a) {
                double g[3], q[3], *row = H + a * stride;
                dipole.rows(R + 3 * a, g, q);
                const double q_ahead = c * q[0] + s * q[1], q_left = c * q[1] - s * q[0];
                for (int b = 0; b < 3; ++b) row[b] -= g[b];
                row[k] = q_ahead, row[k + 1] = q_left, row[k + 2] = q[2];
                row[soft] += ahead * q_ahead;
                row[soft + 1] += left * q_left;
                row[soft + 2] += h_z * q[2];
                by_heading[a] += q[0] * turned_x + q[1] * turned_y + along * (g[0] * s - g[1] * c);
                if (d > 1) row[length] -= place * (g[0] * c + g[1] * s);
            }
        }
        for (int a = 0; a < 3; ++a) {
            // d(heading)/dv = [-sin, cos]/|v|
            H[a * stride + 3] = -s * slowness * by_heading[a];
            H[a * stride + 4] = c * slowness * by_heading[a];
        }
        return gradient;
    }
};

// A dipole that moves and turns: Magnet of sources.py. Sources: PHD15 Paper A eq. (19)-(24).
struct Magnet {
    double density[3], angular_density;  // [m^2/s^3], [rad^2/s^3]

    INLINE int n() const { return 12; }

    // I + once [a]x + twice [a]x^2, into `out`.
    static INLINE void by_cross(const double (&a)[3], double once, double twice,
                                double (&out)[3][3]) {
        const double a2 = a[0] * a[0] + a[1] * a[1] + a[2] * a[2];
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                out[i][k] = twice * a[i] * a[k] + (i == k ? 1.0 - twice * a2 : 0.0);
        for (int i = 0; i < 3; ++i) {
            const int k = (i + 1) % 3, l = (i + 2) % 3;
            out[l][k] += once * a[i];
            out[k][l] -= once * a[i];
        }
    }

    // The moment is turned by the whole angle.
    INLINE void move(const double* x, double dt, Motion& out) const {
        const double angle[3] = {dt * x[9], dt * x[10], dt * x[11]};
        const double t2 = angle[0] * angle[0] + angle[1] * angle[1] + angle[2] * angle[2];
        const double t = std::sqrt(t2);
        double sine = 1.0 - t2 / 6.0, cosine = 0.5 - t2 / 24.0, rest = 1.0 / 6.0 - t2 / 120.0;
        if (t > SMALL_ANGLE) {
            const double half = std::sin(0.5 * t) / t;
            sine = std::sin(t) / t, cosine = 2.0 * half * half, rest = (1.0 - sine) / t2;
        }
        double R[3][3], J[3][3];
        by_cross(angle, sine, cosine, R);
        by_cross(angle, cosine, rest, J);
        out = Motion{6, 6, {0, 1, 2, 6, 7, 8}, {}, {}, {}};
        double m[3];
        for (int a = 0; a < 3; ++a) {
            out.moved[a] = x[a] + dt * x[3 + a];
            out.f[a][0] = 1.0, out.f[a][1] = dt;
            m[a] = out.moved[3 + a] = R[a][0] * x[6] + R[a][1] * x[7] + R[a][2] * x[8];
        }
        for (int a = 0; a < 3; ++a) {
            const int b = (a + 1) % 3, c = (a + 2) % 3;
            for (int k = 0; k < 6; ++k) {
                out.columns[a][k] = k == 1 ? 3 + a : a;
                out.columns[3 + a][k] = 6 + k;
            }
            for (int k = 0; k < 3; ++k) {
                out.f[3 + a][k] = R[a][k];
                // (J e_k) x m, by which the angular velocity turns the moment.
                out.f[3 + a][3 + k] = dt * (J[b][k] * m[c] - J[c][k] * m[b]);
            }
        }
    }

    // (2 tr S^2 + (tr S)^2) / 4 of S = A P A / |m|^2, with A across the moment m.
    static INLINE double second_moment(const double (&P)[3][3], const double* m, double size2) {
        double A[3][3], AP[3][3] = {}, S[3][3] = {}, trace = 0.0, squares = 0.0;
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) A[i][k] = (i == k ? 1.0 : 0.0) - m[i] * m[k] / size2;
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                for (int a = 0; a < 3; ++a) AP[i][k] += A[i][a] * P[a][k] / size2;
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k)
                for (int a = 0; a < 3; ++a) S[i][k] += AP[i][a] * A[a][k];
        for (int i = 0; i < 3; ++i) {
            trace += S[i][i];
            for (int k = 0; k < 3; ++k) squares += S[i][k] * S[k][i];
        }
        return 0.25 * (2.0 * squares + trace * trace);
    }

    // As of RowVehicle. What the Jacobian leaves out of a turn counts as noise, too.
    INLINE void noise(const double*, const double* P, int wide, double dt, const Motion& motion,
                      double* Q) const {
        const double* m = motion.moved + 3;
        const double size2 = m[0] * m[0] + m[1] * m[1] + m[2] * m[2];
        double before[3][3] = {}, after[3][3] = {};
        for (int i = 0; i < 3; ++i) {
            const int k = (i + 1) % 3, l = (i + 2) % 3;
            integrator_noise(Q, wide, i, 3 + i, density[i], dt);
            Q[(9 + i) * wide + 9 + i] = angular_density * dt;
            const double half = 0.5 * angular_density * dt * dt;
            // -[m]x: what the angular velocity does to the moment.
            Q[(6 + k) * wide + 9 + l] = Q[(9 + l) * wide + 6 + k] = half * m[i];
            Q[(6 + l) * wide + 9 + k] = Q[(9 + k) * wide + 6 + l] = -half * m[i];
        }
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) {
                const double q = angular_density * dt * dt * dt / 3.0
                    * ((i == k ? size2 : 0.0) - m[i] * m[k]);
                Q[(6 + i) * wide + 6 + k] = after[i][k] = q;
                for (int a = 0; a < 6; ++a)
                    for (int b = 0; b < 6; ++b) {
                        const double term = motion.f[3 + i][a] * P[(6 + a) * wide + 6 + b]
                            * motion.f[3 + k][b];
                        after[i][k] += term;
                        if (a < 3 && b < 3) before[i][k] += term;
                    }
            }
        // A moment of zero cannot be turned.
        if (!(size2 > 0.0)) return;
        const double more = std::min(1.0, std::max(
            0.0, second_moment(after, m, size2) - second_moment(before, m, size2)));
        for (int i = 0; i < 3; ++i)
            for (int k = 0; k < 3; ++k) Q[(6 + i) * wide + 6 + k] += more * (m[i] * m[k]);
    }

    INLINE double field(const double* x, const double* position, const double* R, double* field,
                        double* H, int stride) const {
        const Dipole dipole({position[0] - x[0], position[1] - x[1], position[2] - x[2]},
                            {x[6], x[7], x[8]});
        for (int a = 0; a < 3; ++a) field[a] = 0.0;
        dipole.add_field(field);
        for (int a = 0; a < 3; ++a) {
            double g[3], q[3], *row = H + a * stride;
            dipole.rows(R + 3 * a, g, q);
            for (int i = 3; i < 12; ++i) row[i] = 0.0;
            for (int i = 0; i < 3; ++i) row[i] = -g[i], row[6 + i] = q[i];
        }
        return dipole.gradient();
    }
};

}  // namespace mag_tracking
