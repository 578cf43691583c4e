// Vectors that change smoothly: one filter step for all strengths (gauss_markov.py).

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "../arrays.hpp"
#include "../processors.hpp"

namespace mag_tracking {

// n vectors of m components, the first n_moving of which change. Each vector has a bank of
// strengths: states (n, n_strengths, n_x), n_x = m + n_moving (all levels, then the rates of the
// changing components); covariances (n, n_strengths, n_x, n_x); log-weights
// (n, n_strengths). `densities` (n_strengths, m) are spectral densities.
struct VectorBank {
    int n, n_strengths, m, n_moving;
    double *x, *P, *log_w;
    const double* densities;

    INLINE int n_x() const { return m + n_moving; }
};

// Scalar measurements: index of the `vector` of each, ascending; rows `H` (n_y, m), values and
// variances.
struct ScalarMeasurements {
    int n;
    const std::int64_t* vector;
    const double *H, *y, *variance;
};

// Predicts levels and rates (n_x) and their covariance by `dt`, with spectral densities q (m).
INLINE void predict(double* x, double* P, const double* q, const VectorBank& bank, double dt) {
    const int m = bank.m, n = bank.n_x();
    for (int i = 0; i < bank.n_moving; ++i) {
        x[i] += dt * x[m + i];
        for (int j = 0; j < n; ++j) P[i * n + j] += dt * P[(m + i) * n + j];
    }
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < bank.n_moving; ++j) P[i * n + j] += dt * P[i * n + m + j];
    for (int i = 0; i < bank.n_moving; ++i) {
        P[i * n + i] += q[i] * (dt * dt * dt) / 3.0;
        P[i * n + m + i] += q[i] * (dt * dt) / 2.0;
        P[(m + i) * n + i] += q[i] * (dt * dt) / 2.0;
        P[(m + i) * n + m + i] += q[i] * dt;
    }
}

// out (n) = h' P: sum of the rows of P (n, n) weighted by h (m), most of which is zero.
INLINE void rows_by(const double* __restrict P, const double* h, int m, int n,
                    double* __restrict out) {
    for (int j = 0; j < n; ++j) out[j] = 0.0;
    for (int i = 0; i < m; ++i) {
        if (h[i] == 0.0) continue;
        for (int j = 0; j < n; ++j) out[j] += h[i] * P[i * n + j];
    }
}

// Updates by a scalar measurement of the levels with row h (m). Returns its log-density. `scratch`
// (3 n) is overwritten.
INLINE double update(double* x, double* __restrict P, const double* h, int m, int n, double y,
                     double variance, double* __restrict scratch) {
    double *PH = scratch, *K = PH + n, *c = K + n;
    rows_by(P, h, m, n, PH);
    double S = 0.0, nu = y;
    for (int j = 0; j < m; ++j) S += h[j] * PH[j], nu -= h[j] * x[j];
    // After a long gap the prediction variance is so large that its rounding exceeds the noise.
    S = std::max(S, 0.0) + variance;
    for (int i = 0; i < n; ++i) {
        K[i] = PH[i] / S;
        x[i] += K[i] * nu;
    }
    // Joseph form, (I - K h') P (I - K h')' + K R K': it adds c K' to P - K (P h)', which would be
    // zero without rounding errors.
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < n; ++j) P[i * n + j] -= K[i] * PH[j];
    rows_by(P, h, m, n, c);
    for (int i = 0; i < n; ++i) {
        const double c_i = variance * K[i] - c[i];
        for (int j = 0; j < n; ++j) P[i * n + j] += c_i * K[j];
        P[i * n + i] = std::max(P[i * n + i], 0.0);
    }
    // Rounding errors differ between the two triangles and could make P indefinite after long gaps.
    for (int i = 1; i < n; ++i)
        for (int j = 0; j < i; ++j)
            P[i * n + j] = P[j * n + i] = 0.5 * (P[i * n + j] + P[j * n + i]);
    constexpr double two_pi = 6.283185307179586;
    return -0.5 * (nu * nu / S + std::log(two_pi * S));
}

// Predicts by `dt` [s] and updates. Returns the log-density of the measurements given the previous
// measurements. `switch_s` is the mean time between switches of the strength.
FOR_PROCESSORS static double step(const VectorBank& bank, const ScalarMeasurements& in, double dt,
                                  double switch_s) {
    const int n = bank.n_strengths, m = bank.m, n_x = bank.n_x();
    const double stay = std::exp(-dt / switch_s);
    std::vector<double> scratch(3 * n_x);
    double evidence = 0.0;
    int first = 0;
    for (int v = 0; v < bank.n; ++v) {
        int after = first;
        while (after < in.n && in.vector[after] == v) ++after;
        double* log_w = bank.log_w + v * n;
        double top = -std::numeric_limits<double>::infinity(), total = 0.0;
        for (int k = 0; k < n; ++k) {
            double* x = bank.x + (v * n + k) * n_x;
            double* P = bank.P + (v * n + k) * n_x * n_x;
            log_w[k] = std::log(stay * std::exp(log_w[k]) + (1.0 - stay) / n + 1e-300);
            predict(x, P, bank.densities + k * m, bank, dt);
            for (int i = first; i < after; ++i)
                log_w[k] += update(x, P, in.H + i * m, m, n_x, in.y[i], in.variance[i],
                                   scratch.data());
            top = std::max(top, log_w[k]);
        }
        for (int k = 0; k < n; ++k) total += std::exp(log_w[k] - top);
        const double of_vector = top + std::log(total);
        for (int k = 0; k < n; ++k) log_w[k] -= of_vector;
        evidence += of_vector;
        first = after;
    }
    return evidence;
}

}  // namespace mag_tracking
