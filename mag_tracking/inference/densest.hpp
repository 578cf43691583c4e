// The hypothesis of a bank to publish: where the spatial mixture is densest (filter_bank.py).

#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <map>
#include <vector>

namespace mag_tracking {

// Terms below exp(-40) are negligible in a sum that contains 1.
constexpr double NOTHING = 40.0;

// Inverse of the Cholesky factor of a covariance, and the weighted log-density at the mean, up to a
// common constant.
struct Whitener {
    double w00, w10, w11, w20, w21, w22, log_top;

    // Returns false if `C` (3, 3) is not positive definite.
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

    // Squared Mahalanobis distance of a difference d.
    double square(double d0, double d1, double d2) const {
        const double a = w00 * d0, b = w10 * d0 + w11 * d1, c = w20 * d0 + w21 * d1 + w22 * d2;
        return a * a + b * b + c * c;
    }
};

// Index of the mean at which a mixture is densest; -1 if a covariance is not positive definite. The
// mixture has means (n, 3), covariances (n, 3, 3) and log-weights (n).
inline std::ptrdiff_t densest(std::size_t n, const double* mean, const double* covariance,
                              const double* log_w) {
    std::vector<Whitener> each(n);
    for (std::size_t i = 0; i < n; ++i)
        if (!each[i].set(covariance + 9 * i, log_w[i])) return -1;
    std::ptrdiff_t best = -1;
    double most = -std::numeric_limits<double>::infinity();
    for (std::size_t k = 0; k < n; ++k) {
        // Relative to the density of the component itself, which is part of every sum.
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

// n hypotheses with states (n, n_x); the first three states are the position.
struct Mixture {
    std::size_t n, n_x;
    const double *x, *P, *log_w;
    const std::int64_t *label, *kind;
};

// Keeps the `rows` of the heaviest class; `of` (n) contains the class of each hypothesis.
inline void keep_heaviest(std::vector<std::size_t>& rows, const std::int64_t* of,
                          const double* log_w) {
    double top = -std::numeric_limits<double>::infinity();
    for (const std::size_t i : rows) top = std::max(top, log_w[i]);
    std::map<std::int64_t, double> total;
    for (const std::size_t i : rows)
        total[of[i]] += std::isfinite(top) ? std::exp(log_w[i] - top) : 0.0;
    const auto heaviest =
        std::max_element(total.begin(), total.end(), [](const auto& a, const auto& b) {
        return a.second < b.second;
    });
    rows.erase(std::remove_if(rows.begin(), rows.end(),
                              [&](std::size_t i) { return of[i] != heaviest->first; }),
               rows.end());
}

// Index of the hypothesis to publish; the bank must not be empty. Hypotheses lighter than the
// heaviest one by more than `negligible` are ignored.
inline std::size_t best_of(const Mixture& bank, double negligible) {
    std::vector<std::size_t> rows(bank.n);
    for (std::size_t i = 0; i < bank.n; ++i) rows[i] = i;
    keep_heaviest(rows, bank.label, bank.log_w);
    keep_heaviest(rows, bank.kind, bank.log_w);
    const std::size_t heaviest =
        *std::max_element(rows.begin(), rows.end(), [&](std::size_t a, std::size_t b) {
        return bank.log_w[a] < bank.log_w[b];
    });
    rows.erase(std::remove_if(rows.begin(), rows.end(),
                              [&](std::size_t i) {
        return bank.log_w[i] < bank.log_w[heaviest] - negligible;
    }),
               rows.end());
    std::vector<double> mean, covariance, log_w;
    for (const std::size_t i : rows) {
        log_w.push_back(bank.log_w[i]);
        for (std::size_t a = 0; a < 3; ++a) {
            mean.push_back(bank.x[i * bank.n_x + a]);
            for (std::size_t b = 0; b < 3; ++b)
                covariance.push_back(bank.P[(i * bank.n_x + a) * bank.n_x + b]);
        }
    }
    const auto found = densest(rows.size(), mean.data(), covariance.data(), log_w.data());
    return found < 0 ? heaviest : rows[std::size_t(found)];
}

}  // namespace mag_tracking
