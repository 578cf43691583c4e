// Target models of vehicles.py and sources.py, for one state at a time.
//
// The Python classes RowVehicle and Magnet define the states and cite the references; the tests
// compare both implementations. A model predicts a state (`move`) and computes the process noise of
// the prediction (`noise`) and the field at one sensor with its derivative (`field`).

#pragma once

#include <algorithm>
#include <cmath>

#include "dipole.hpp"
#include "motion.hpp"
#include "vehicles.hpp"

namespace mag_tracking {

// A dipole that moves and rotates: Magnet of sources.py, PHD15 Paper A eq. (19)-(24).
struct Magnet {
    double density[3], angular_density;  // [m^2/s^3], [rad^2/s^3]

    INLINE int n() const { return 12; }

    // Writes I + once [a]x + twice [a]x^2 to `out`.
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

    // The moment is rotated by the full angle.
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
                // Derivative of the moment by the angular velocity: (J e_k) x m.
                out.f[3 + a][3 + k] = dt * (J[b][k] * m[c] - J[c][k] * m[b]);
            }
        }
    }

    // (2 tr S^2 + (tr S)^2) / 4 of S = A P A / |m|^2; A projects onto the plane normal to m.
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

    // As RowVehicle::noise. The second-order terms of a rotation, which the Jacobian omits, are
    // added as noise.
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
            // -[m]x: effect of the angular velocity on the moment.
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
        // A zero moment cannot be rotated.
        if (!(size2 > 0.0)) return;
        const double more = std::min(1.0, std::max(0.0, second_moment(after, m, size2)
                                                            - second_moment(before, m, size2)));
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

// Several vehicles whose fields add up; their states are concatenated.
struct Vehicles {
    RowVehicle one;
    int count;

    INLINE int n() const { return count * one.n(); }

    INLINE void move(const double* x, double dt, Motion& out) const {
        Motion of_one;
        out.n = 0;
        for (int v = 0; v < count; ++v) {
            const int first = v * one.n();
            one.move(x + first, dt, of_one);
            out.width = of_one.width;
            for (int r = 0; r < of_one.n; ++r, ++out.n) {
                out.rows[out.n] = first + of_one.rows[r];
                out.moved[out.n] = of_one.moved[r];
                for (int m = 0; m < of_one.width; ++m) {
                    out.columns[out.n][m] = first + of_one.columns[r][m];
                    out.f[out.n][m] = of_one.f[r][m];
                }
            }
        }
    }

    INLINE void noise(const double* x, const double* P, int wide, double dt, const Motion& motion,
                      double* Q) const {
        for (int v = 0; v < count; ++v) {
            const int first = v * one.n(), block = first * wide + first;
            one.noise(x + first, P + block, wide, dt, motion, Q + block);
        }
    }
};

// Field and derivative, as Target::field. Returns the magnitude of the model error [T]: the
// gradient times the length scale in `lengths` [m], one per target.
template <class Target>
INLINE double field_and_error(const Target& target, const double* x, const double* position,
                              const double* R, const double* lengths, double* field, double* H,
                              int stride) {
    return lengths[0] * target.field(x, position, R, field, H, stride);
}

// The model errors of several vehicles are independent.
INLINE double field_and_error(const Vehicles& vehicles, const double* x, const double* position,
                              const double* R, const double* lengths, double* field, double* H,
                              int stride) {
    double square = 0.0;
    for (int a = 0; a < 3; ++a) field[a] = 0.0;
    for (int v = 0; v < vehicles.count; ++v) {
        const int first = v * vehicles.one.n();
        double of_one[3];
        const double error =
            lengths[v] * vehicles.one.field(x + first, position, R, of_one, H + first, stride);
        for (int a = 0; a < 3; ++a) field[a] += of_one[a];
        square += error * error;
    }
    return std::sqrt(square);
}

}  // namespace mag_tracking
