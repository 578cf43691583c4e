// Anderson functions of one pass; anderson.py says what they are.

#pragma once

#include <cmath>
#include <vector>

#include "../arrays.hpp"

namespace mag_tracking {

constexpr int N_ANDERSON = 4;  // Three functions, and a constant.

// A constant and the Anderson functions of `n` times t [s], one after the other (4, n).
//
// Source: TSP14 eq. (23), with the exponent 5/2.
inline std::vector<double> anderson_functions(const double* t, std::size_t n, double time,
                                              double scale) {
    std::vector<double> f(N_ANDERSON * n);
    for (std::size_t i = 0; i < n; ++i) {
        const double tau = (t[i] - time) / scale;
        const double cosine = 1.0 / std::sqrt(tau * tau + 1.0), sine = tau * cosine;
        const double cube = cosine * cosine * cosine;
        f[i] = 1.0;
        f[n + i] = cube * (cosine * cosine);
        f[2 * n + i] = cube * (sine * cosine);
        f[3 * n + i] = cube * (sine * sine);
    }
    return f;
}

// Sum of products of `n` numbers; each of `b` is `stride` behind the one before.
INLINE double dot(const double* a, const double* b, std::size_t n, std::size_t stride = 1) {
    // Four sums: an addition does not wait for the one before it.
    double sums[4] = {};
    std::size_t i = 0;
    for (; i + 4 <= n; i += 4)
        for (std::size_t k = 0; k < 4; ++k) sums[k] += a[i + k] * b[(i + k) * stride];
    for (; i < n; ++i) sums[0] += a[i] * b[i * stride];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

// Sum of squares of y (n, k) that a pass leaves over; the functions are made orthonormal one after
// the other.
inline double anderson_residual(const double* t, const double* y, std::size_t n, std::size_t k,
                                double time, double scale) {
    std::vector<double> f = anderson_functions(t, n, time, scale);
    double left = dot(y, y, n * k);
    for (int m = 0; m < N_ANDERSON; ++m) {
        double* f_m = f.data() + m * n;
        const double size = dot(f_m, f_m, n);
        // Twice: once leaves what rounding adds.
        for (int again = 0; again < 2; ++again)
            for (int earlier = 0; earlier < m; ++earlier) {
                const double* other = f.data() + earlier * n;
                const double along = dot(f_m, other, n);
                for (std::size_t i = 0; i < n; ++i) f_m[i] -= along * other[i];
            }
        const double rest = dot(f_m, f_m, n);
        // A function that the others make up adds nothing.
        const double factor = rest > 1e-20 * size ? 1.0 / std::sqrt(rest) : 0.0;
        for (std::size_t i = 0; i < n; ++i) f_m[i] *= factor;
        for (std::size_t column = 0; column < k; ++column) {
            const double along = dot(f_m, y + column, n, k);
            left -= along * along;
        }
    }
    return left;
}

}  // namespace mag_tracking
