// Where a mixture of Gaussians in space is densest, of their own means (filter_bank.py).

#pragma once

#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace mag_tracking {

// exp(-40) changes no sum of which one is a part.
constexpr double NOTHING = 40.0;

// The inverse of the lower root of a covariance, and the logarithm of its density at the mean, but
// for what is the same of all.
struct Whitener {
    double w00, w10, w11, w20, w21, w22, log_top;

    // False: `C` (3, 3) is not positive definite.
    bool set(const double* C, double log_w) {
        const double l00 = std::sqrt(C[0]), l10 = C[3] / l00, l20 = C[6] / l00;
        const double l11 = std::sqrt(C[4] - l10 * l10), l21 = (C[7] - l20 * l10) / l11;
        const double l22 = std::sqrt(C[8] - l20 * l20 - l21 * l21);
        w00 = 1.0 / l00, w11 = 1.0 / l11, w22 = 1.0 / l22;
        w10 = -l10 * w00 * w11, w21 = -l21 * w11 * w22;
        w20 = (l10 * l21 - l20 * l11) * w00 * w11 * w22;
        log_top = log_w + std::log(w00 * w11 * w22);
        return l00 > 0.0 && l11 > 0.0 && l22 > 0.0 && std::isfinite(log_top);
    }

    // Squared distance of a mean that is away by d.
    double square(double d0, double d1, double d2) const {
        const double a = w00 * d0, b = w10 * d0 + w11 * d1, c = w20 * d0 + w21 * d1 + w22 * d2;
        return a * a + b * b + c * c;
    }
};

// Of n means (n, 3) with covariances (n, 3, 3) and logarithms of weights (n), the one at which the
// mixture is densest; -1 where a covariance is not positive definite.
inline std::ptrdiff_t densest(std::size_t n, const double* mean, const double* covariance,
                              const double* log_w) {
    std::vector<Whitener> each(n);
    for (std::size_t i = 0; i < n; ++i)
        if (!each[i].set(covariance + 9 * i, log_w[i])) return -1;
    std::ptrdiff_t best = -1;
    double most = -std::numeric_limits<double>::infinity();
    for (std::size_t k = 0; k < n; ++k) {
        // Relative to what the component itself has there: no sum is without it.
        const double* at = mean + 3 * k;
        double sum = 0.0;
        for (std::size_t i = 0; i < n; ++i) {
            const double* m = mean + 3 * i;
            const double more = each[i].log_top - each[k].log_top
                - 0.5 * each[i].square(at[0] - m[0], at[1] - m[1], at[2] - m[2]);
            if (more > -NOTHING) sum += std::exp(more);
        }
        const double density = each[k].log_top + std::log(sum);
        if (density > most) most = density, best = std::ptrdiff_t(k);
    }
    return best;
}

}  // namespace mag_tracking
