// Anderson functions of one pass, as defined in passes.py.

#pragma once

#include <cmath>
#include <vector>

#include "../arrays.hpp"

namespace mag_tracking {

constexpr int N_ANDERSON = 4;  // Three functions and a constant.

// A constant and the three Anderson functions at `n` times t [s]: (4, n). `time` [s] is the time of
// the closest point of approach (CPA), `scale` [s] the CPA range over the speed.
//
// TSP14 eq. (23), with the exponent 5/2.
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

// Dot product of `n` elements; `b` has a stride of `stride` elements.
INLINE double dot(const double* a, const double* b, std::size_t n, std::size_t stride = 1) {
    // Four independent sums, so that an addition does not wait for the previous addition.
    double sums[4] = {};
    std::size_t i = 0;
    for (; i + 4 <= n; i += 4)
        for (std::size_t k = 0; k < 4; ++k) sums[k] += a[i + k] * b[(i + k) * stride];
    for (; i < n; ++i) sums[0] += a[i] * b[i * stride];
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
}

// Residual sum of squares of y (n, k) after a fit of the functions to each column. The functions
// are orthonormalised by the Gram-Schmidt process.
inline double anderson_residual(const double* t, const double* y, std::size_t n, std::size_t k,
                                double time, double scale) {
    std::vector<double> f = anderson_functions(t, n, time, scale);
    double left = dot(y, y, n * k);
    for (int m = 0; m < N_ANDERSON; ++m) {
        double* f_m = f.data() + m * n;
        const double size = dot(f_m, f_m, n);
        // Orthogonalise twice to remove rounding errors.
        for (int again = 0; again < 2; ++again)
            for (int earlier = 0; earlier < m; ++earlier) {
                const double* other = f.data() + earlier * n;
                const double along = dot(f_m, other, n);
                for (std::size_t i = 0; i < n; ++i) f_m[i] -= along * other[i];
            }
        const double rest = dot(f_m, f_m, n);
        // A function that depends linearly on the previous ones contributes nothing.
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
