// Vectors that change smoothly, one step of all strengths (gauss_markov.py).

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace mag_tracking {

// n vectors of m components, each with a bank of strengths: states (n, n_strengths, 2 m) are levels
// and rates, with their covariances (n, n_strengths, 2 m, 2 m); log weights (n, n_strengths);
// squared densities (n_strengths, m).
struct VectorBank {
    int n, n_strengths, m;
    double *x, *P, *log_w;
    const double* densities;
};

// Scalar measurements: `vector` says of which each is, ascending; (n_y, m) `H`, values, variances.
struct ScalarMeasurements {
    int n;
    const std::int64_t* vector;
    const double *H, *y, *variance;
};

// Move levels and rates (2 m) and their covariance on by `dt`, with densities q (m).
inline void predict(double* x, double* P, const double* q, int m, double dt) {
    const int n = 2 * m;
    for (int i = 0; i < m; ++i) {
        x[i] += dt * x[m + i];
        for (int j = 0; j < n; ++j) P[i * n + j] += dt * P[(m + i) * n + j];
    }
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < m; ++j) P[i * n + j] += dt * P[i * n + m + j];
    for (int i = 0; i < m; ++i) {
        P[i * n + i] += q[i] * (dt * dt * dt) / 3.0;
        P[i * n + m + i] += q[i] * (dt * dt) / 2.0;
        P[(m + i) * n + i] += q[i] * (dt * dt) / 2.0;
        P[(m + i) * n + m + i] += q[i] * dt;
    }
}

// Update with a scalar measurement h (m) of the levels; its log-density. `PH` (2 m) is overwritten.
inline double update(double* x, double* P, const double* h, int m, double y, double variance,
                     double* PH) {
    const int n = 2 * m;
    double S = 0.0, nu = y;
    for (int i = 0; i < n; ++i) {
        PH[i] = 0.0;
        for (int j = 0; j < m; ++j) PH[i] += P[i * n + j] * h[j];
    }
    for (int j = 0; j < m; ++j) S += h[j] * PH[j], nu -= h[j] * x[j];
    // After a long gap the prediction is so wide that rounding errors exceed the noise.
    S = std::max(S, 0.0) + variance;
    for (int i = 0; i < n; ++i) {
        const double gain = PH[i] / S;
        x[i] += gain * nu;
        for (int j = 0; j < n; ++j) P[i * n + j] -= gain * PH[j];
    }
    // Joseph's form: (I - K h') P (I - K h')' + K R K', with K = PH / S; symmetric.
    for (int i = 0; i < n; ++i) {
        double left = 0.0;
        for (int j = 0; j < m; ++j) left += P[i * n + j] * h[j];
        for (int j = 0; j < n; ++j) P[i * n + j] += (variance * PH[i] / S - left) * PH[j] / S;
    }
    for (int i = 0; i < n; ++i) {
        P[i * n + i] = std::max(P[i * n + i], 0.0);
        for (int j = 0; j < i; ++j)
            P[i * n + j] = P[j * n + i] = 0.5 * (P[i * n + j] + P[j * n + i]);
    }
    constexpr double two_pi = 6.283185307179586;
    return -0.5 * (nu * nu / S + std::log(two_pi * S));
}

// Log-density of the measurements given those before, `dt` [s] ago; a strength holds for `switch_s`
// in the mean.
inline double step(const VectorBank& bank, const ScalarMeasurements& in, double dt,
                   double switch_s) {
    const int n = bank.n_strengths, m = bank.m;
    const double stay = std::exp(-dt / switch_s);
    std::vector<double> PH(2 * m);
    double evidence = 0.0;
    int first = 0;
    for (int v = 0; v < bank.n; ++v) {
        int after = first;
        while (after < in.n && in.vector[after] == v) ++after;
        double* log_w = bank.log_w + v * n;
        double top = -std::numeric_limits<double>::infinity(), total = 0.0;
        for (int k = 0; k < n; ++k) {
            double* x = bank.x + (v * n + k) * 2 * m;
            double* P = bank.P + (v * n + k) * 4 * m * m;
            log_w[k] = std::log(stay * std::exp(log_w[k]) + (1.0 - stay) / n + 1e-300);
            predict(x, P, bank.densities + k * m, m, dt);
            for (int i = first; i < after; ++i)
                log_w[k] += update(x, P, in.H + i * m, m, in.y[i], in.variance[i], PH.data());
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
