// Steps of a Kalman filter and of its smoother, for one hypothesis at a time.
//
// The state consists of the target state (n_t), which affects all sensors, n_own states of each
// sensor, which affect only that sensor, and three backgrounds of each sensor. The update processes
// the sensors one after the other, linearised at one common point. The result equals the stacked
// update, at a fraction of the cost.

#pragma once

#include <cmath>
#include <cstring>
#include <limits>

#include "wide_rows.hpp"

namespace mag_tracking {

// Gains of an update, per sensor, given the sensors before it: z = W u is the whitened innovation,
// x += G' z and P -= G' G, with G = W [H | I] P.
struct Gains {
    double* H;  // (n_sensors, 3, n_seen)
    double* G;  // (n_sensors, 3, wide); rows of missing axes are zero.
    double* z;  // (n_sensors, 3)
    double* W;  // (n_sensors, 6) lower triangle, row by row.
};

// P = F P F', in place; `T` (motion.n, wide) is overwritten.
INLINE void move_covariance(double* __restrict P, const Sizes& n, const Motion& motion,
                            double* __restrict T) {
    for (int r = 0; r < motion.n; ++r) {
        Eight* row = eights(T + r * n.wide);
        for (int v = 0; v < n.n_eights; ++v) {
            Eight sum = {};
            for (int m = 0; m < motion.width; ++m)
                sum += motion.f[r][m] * eights(P + motion.columns[r][m] * n.wide)[v];
            row[v] = sum;
        }
    }
    for (int r = 0; r < motion.n; ++r)
        for (int v = 0; v < n.n_eights; ++v)
            eights(P + motion.rows[r] * n.wide)[v] = eights(T + r * n.wide)[v];
    for (int i = 0; i < n.n_x; ++i)
        for (int r = 0; r < motion.n; ++r) P[i * n.wide + motion.rows[r]] = T[r * n.wide + i];
    for (int r = 0; r < motion.n; ++r)
        for (int q = 0; q <= r; ++q) {
            double product = 0.0;
            for (int m = 0; m < motion.width; ++m)
                product += motion.f[q][m] * T[r * n.wide + motion.columns[q][m]];
            P[motion.rows[r] * n.wide + motion.rows[q]] = product;
            P[motion.rows[q] * n.wide + motion.rows[r]] = product;
        }
}

// Multiplies the states after the target's by `decay`, then adds `variance`; both (n_x - n_t).
INLINE void drift(double* x, double* __restrict P, const Sizes& n, const double* decay,
                  const double* variance) {
    for (int i = n.n_t; i < n.n_x; ++i) {
        const double d = decay[i - n.n_t];
        if (d != 1.0) {
            x[i] *= d;
            Eight* row = eights(P + i * n.wide);
            for (int v = 0; v < n.n_eights; ++v) row[v] *= d;
            for (int k = 0; k < n.n_x; ++k) P[k * n.wide + i] *= d;
        }
        P[i * n.wide + i] += variance[i - n.n_t];
    }
}

// G = [H | I] P of sensor j, four rows of P at a time to reduce accesses to G.
INLINE void gain_rows(const double* __restrict P, const double* H, const Sizes& n, int j,
                      double* __restrict G) {
    Eight *g0 = eights(G), *g1 = g0 + n.n_eights, *g2 = g1 + n.n_eights;
    const double *h0 = H, *h1 = h0 + n.n_seen(), *h2 = h1 + n.n_seen();
    const Eight* own = eights(P + n.background(j) * n.wide);
    for (int v = 0; v < 3 * n.n_eights; ++v) g0[v] = own[v];
    int c = 0;
    for (; c + 4 <= n.n_t; c += 4) {
        const Eight* p = eights(P + c * n.wide);
        const int m = n.n_eights;
        for (int v = 0; v < m; ++v) {
            const Eight p0 = p[v], p1 = p[v + m], p2 = p[v + 2 * m], p3 = p[v + 3 * m];
            g0[v] += h0[c] * p0 + h0[c + 1] * p1 + h0[c + 2] * p2 + h0[c + 3] * p3;
            g1[v] += h1[c] * p0 + h1[c + 1] * p1 + h1[c + 2] * p2 + h1[c + 3] * p3;
            g2[v] += h2[c] * p0 + h2[c + 1] * p1 + h2[c + 2] * p2 + h2[c + 3] * p3;
        }
    }
    for (; c < n.n_seen(); ++c) {
        const Eight* p = eights(P + n.seen(j, c) * n.wide);
        for (int v = 0; v < n.n_eights; ++v) {
            const Eight row = p[v];
            g0[v] += h0[c] * row;
            g1[v] += h1[c] * row;
            g2[v] += h2[c] * row;
        }
    }
}

// P -= G' G, from `first_eight` of each row on. Both triangles get the same products, so that P
// stays symmetric. Four rows of P at a time, to read G less often.
INLINE void subtract_products(double* __restrict P, const double* __restrict G, const Sizes& n) {
    const int m = n.n_eights;
    const Eight *g0 = eights(G), *g1 = g0 + m, *g2 = g1 + m;
    const double *a0 = G, *a1 = a0 + n.wide, *a2 = a1 + n.wide;
    int i = 0;
    for (; i + 4 <= n.n_x; i += 4) {
        Eight* row = eights(P + i * n.wide);
        for (int v = n.first_eight(i); v < m; ++v) {
            const Eight b0 = g0[v], b1 = g1[v], b2 = g2[v];
            for (int k = 0; k < 4; ++k)
                row[v + k * m] -= a0[i + k] * b0 + a1[i + k] * b1 + a2[i + k] * b2;
        }
    }
    for (; i < n.n_x; ++i) {
        Eight* row = eights(P + i * n.wide);
        for (int v = n.first_eight(i); v < m; ++v)
            row[v] -= a0[i] * g0[v] + a1[i] * g1[v] + a2[i] * g2[v];
    }
}

// Updates a hypothesis by sensor j, in place, linearised at `x_lin` (n_x). If the sizes are
// `is_halved`, P must be completed by `complete` after the last sensor.
//
// y (3), C (3, 3): measurement, NaN for a missing axis, and noise covariance, without NaN. h (3),
// H (3, n_seen): predicted field without the background, and its derivative. `inflation` is added
// to the variance of each axis. G (3, wide), z (3) and W (6) are written.
// Returns the normalised innovation squared; adds the log-likelihood to `log_likelihood`.
INLINE double update_by_sensor(double* x, double* __restrict P, const double* x_lin,
                               const double* y, const double* C, const double* h, const double* H,
                               double inflation, const Sizes& n, int j, double* __restrict G,
                               double* z, double* W, double& log_likelihood) {
    const int wide = n.wide, first = n.background(j);
    if (n.is_halved) {
        complete_rows(P, n, n.own(j), n.own(j) + n.n_own);
        complete_rows(P, n, first, first + 3);
    }
    gain_rows(P, H, n, j, G);
    bool missing[3];
    int present = 0;
    for (int a = 0; a < 3; ++a) {
        missing[a] = std::isnan(y[a]);
        present += !missing[a];
        if (missing[a]) std::memset(G + a * wide, 0, wide * sizeof(double));
    }
    double S[3][3], u[3];
    for (int a = 0; a < 3; ++a) {
        u[a] = y[a] - h[a] - x[first + a];
        for (int b = 0; b <= a; ++b) S[a][b] = C[3 * a + b] + G[a * wide + first + b];
        S[a][a] += inflation;
    }
    const double *h0 = H, *h1 = h0 + n.n_seen(), *h2 = h1 + n.n_seen();
    for (int c = 0; c < n.n_seen(); ++c) {
        const int i = n.seen(j, c);
        const double off = x[i] - x_lin[i], t1 = G[wide + i], t2 = G[2 * wide + i];
        u[0] -= h0[c] * off;
        u[1] -= h1[c] * off;
        u[2] -= h2[c] * off;
        S[0][0] += h0[c] * G[i];
        S[1][0] += h0[c] * t1;
        S[1][1] += h1[c] * t1;
        S[2][0] += h0[c] * t2;
        S[2][1] += h1[c] * t2;
        S[2][2] += h2[c] * t2;
    }
    for (int a = 0; a < 3; ++a)
        if (missing[a]) {
            u[a] = 0.0;
            for (int b = 0; b < 3; ++b) S[std::max(a, b)][std::min(a, b)] = a == b ? 1.0 : 0.0;
        }
    // S = L diag(e) L' with a unit lower triangular L.
    const double l10 = S[1][0] / S[0][0], l20 = S[2][0] / S[0][0];
    const double e0 = S[0][0], e1 = S[1][1] - l10 * S[1][0], e21 = S[2][1] - l20 * S[1][0];
    const double l21 = e21 / e1, e2 = S[2][2] - l20 * S[2][0] - l21 * e21;
    const double r0 = 1.0 / std::sqrt(e0), r1 = 1.0 / std::sqrt(e1), r2 = 1.0 / std::sqrt(e2);
    Eight *g0 = eights(G), *g1 = g0 + n.n_eights, *g2 = g1 + n.n_eights;
    for (int v = 0; v < n.n_eights; ++v) {
        const Eight t0 = g0[v], t1 = g1[v] - l10 * t0;
        g2[v] = r2 * (g2[v] - l20 * t0 - l21 * t1);
        g1[v] = r1 * t1;
        g0[v] = r0 * t0;
    }
    const double u1 = u[1] - l10 * u[0];
    const double z0 = r0 * u[0], z1 = r1 * u1, z2 = r2 * (u[2] - l20 * u[0] - l21 * u1);
    for (int v = 0; v < n.n_eights; ++v) eights(x)[v] += z0 * g0[v] + z1 * g1[v] + z2 * g2[v];
    subtract_products(P, G, n);
    z[0] = z0, z[1] = z1, z[2] = z2;
    W[0] = r0, W[1] = -r1 * l10, W[2] = r1;
    W[3] = r2 * (l10 * l21 - l20), W[4] = -r2 * l21, W[5] = r2;
    const double nis = z0 * z0 + z1 * z1 + z2 * z2;
    log_likelihood -= 0.5 * (nis + std::log(e0 * e1 * e2) + present * std::log(2.0 * M_PI));
    return present ? nis : std::numeric_limits<double>::quiet_NaN();
}

// Propagates the adjoint state `after` (wide) backwards over an update, in place; P times it is the
// correction of a smoothed state. Modified Bryson-Frazier smoother, sensor by sensor (Bierman 1973,
// Fixed interval smoothing with discrete measurements). No covariance is inverted, so that exactly
// known and fully correlated states need no special treatment.
INLINE void before_update(double* __restrict after, const Sizes& n, const Gains& gains) {
    for (int j = n.n_sensors - 1; j >= 0; --j) {
        const double *H = gains.H + j * 3 * n.n_seen(), *G = gains.G + j * 3 * n.wide;
        const double *z = gains.z + 3 * j, *W = gains.W + 6 * j;
        double v[3];
        for (int a = 0; a < 3; ++a) {
            Eight products = {};
            for (int i = 0; i < n.n_eights; ++i)
                products += eights(G + a * n.wide)[i] * eights(after)[i];
            v[a] = z[a];
            for (int i = 0; i < EIGHT; ++i) v[a] -= products[i];
        }
        const double u[3] = {W[0] * v[0] + W[1] * v[1] + W[3] * v[2], W[2] * v[1] + W[4] * v[2],
                             W[5] * v[2]};
        for (int a = 0; a < 3; ++a, H += n.n_seen()) {
            for (int c = 0; c < n.n_t; ++c) after[c] += u[a] * H[c];
            for (int c = 0; c < n.n_own; ++c) after[n.own(j) + c] += u[a] * H[n.n_t + c];
            after[n.background(j) + a] += u[a];
        }
    }
}

// Propagates the adjoint state `after` backwards over a prediction, in place.
INLINE void before_move(double* after, const Sizes& n, const Motion& motion, const double* decay) {
    double moved[MAX_ROWS];
    for (int r = 0; r < motion.n; ++r) {
        moved[r] = after[motion.rows[r]];
        after[motion.rows[r]] = 0.0;
    }
    for (int r = 0; r < motion.n; ++r)
        for (int m = 0; m < motion.width; ++m)
            after[motion.columns[r][m]] += motion.f[r][m] * moved[r];
    for (int i = n.n_t; i < n.n_x; ++i) after[i] *= decay[i - n.n_t];
}

// Propagates the adjoint information `after` (n_x, wide) backwards over an update, in place;
// P - P `after` P is the covariance of a smoothed state. `y` (n_sensors, 3) is NaN for missing
// axes; `T` and `B` (3, wide) are overwritten.
INLINE void information_before_update(double* __restrict after, const Sizes& n, const Gains& gains,
                                      const double* y, double* __restrict T, double* __restrict B) {
    const int wide = n.wide;
    for (int j = n.n_sensors - 1; j >= 0; --j) {
        const double *H = gains.H + j * 3 * n.n_seen(), *G = gains.G + j * 3 * wide;
        const double* W = gains.W + 6 * j;
        const double L[3][3] = {{W[0], 0.0, 0.0}, {W[1], W[2], 0.0}, {W[3], W[4], W[5]}};
        // B = W [H | I], without missing axes, which have no gain and no information.
        std::memset(B, 0, 3 * wide * sizeof(double));
        for (int b = 0; b < 3; ++b) {
            if (std::isnan(y[3 * j + b])) continue;
            for (int a = b; a < 3; ++a) {
                for (int c = 0; c < n.n_seen(); ++c)
                    B[a * wide + n.seen(j, c)] += L[a][b] * H[b * n.n_seen() + c];
                B[a * wide + n.background(j) + b] += L[a][b];
            }
        }
        // (I - G' B)' after (I - G' B) + B' B = after - B' T - T' B + B' (I + T G') B, T = G after.
        double M[3][3];
        for (int a = 0; a < 3; ++a) {
            Eight* row = eights(T + a * wide);
            for (int v = 0; v < n.n_eights; ++v) {
                Eight sum = {};
                for (int k = 0; k < n.n_x; ++k)
                    sum += G[a * wide + k] * eights(after + k * wide)[v];
                row[v] = sum;
            }
        }
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b <= a; ++b) {
                double product = a == b ? 1.0 : 0.0;
                for (int i = 0; i < n.n_x; ++i) product += T[a * wide + i] * G[b * wide + i];
                M[a][b] = M[b][a] = product;
            }
        for (int i = 0; i < n.n_x; ++i) {
            Eight* row = eights(after + i * wide);
            for (int a = 0; a < 3; ++a) {
                const double b = B[a * wide + i];
                const double by_b = M[a][0] * B[i] + M[a][1] * B[wide + i]
                                    + M[a][2] * B[2 * wide + i] - T[a * wide + i];
                for (int v = 0; v < n.n_eights; ++v)
                    row[v] += by_b * eights(B + a * wide)[v] - b * eights(T + a * wide)[v];
            }
        }
    }
}

// Propagates the adjoint information `after` backwards over a prediction, in place: F' after F.
// `T` (motion.n, wide) is overwritten.
INLINE void information_before_move(double* __restrict after, const Sizes& n, const Motion& motion,
                                    const double* decay, double* __restrict T) {
    // Rows, then columns: a column of F' is a row of F.
    for (int pass = 0; pass < 2; ++pass) {
        const int row = pass ? 1 : n.wide, along = pass ? n.wide : 1;
        for (int r = 0; r < motion.n; ++r)
            for (int i = 0; i < n.n_x; ++i) {
                T[r * n.wide + i] = after[motion.rows[r] * row + i * along];
                after[motion.rows[r] * row + i * along] = 0.0;
            }
        for (int r = 0; r < motion.n; ++r)
            for (int m = 0; m < motion.width; ++m)
                for (int i = 0; i < n.n_x; ++i)
                    after[motion.columns[r][m] * row + i * along] +=
                        motion.f[r][m] * T[r * n.wide + i];
        for (int k = n.n_t; k < n.n_x; ++k)
            for (int i = 0; i < n.n_x; ++i) after[k * row + i * along] *= decay[k - n.n_t];
    }
}

}  // namespace mag_tracking
