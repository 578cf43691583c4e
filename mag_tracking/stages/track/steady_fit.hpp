// Fit of a row of dipoles on a steady path to the samples of a pass (pass_samples.py).

#pragma once

#include <cstdint>
#include <vector>

#include "../../inference/separable.hpp"
#include "../../physics/steady_pass.hpp"

namespace mag_tracking {

// Model of `physics.passes.SteadyPass` for `SeparableFit`.
class SteadyModel {
  public:
    // The moments of the dipoles are `combinations` (d, d) times the linear parameters.
    SteadyModel(const Row& row, const double* combinations, const Samples& samples,
                const std::int64_t* clocks, const double* fixed, int n_whole,
                const std::int64_t* free, int n_free)
        : row_(row), combinations_(combinations), samples_(samples), clocks_(clocks), free_(free),
          n_free_(n_free), whole_(fixed, fixed + n_whole), unit_(9 * row.n), moments_(3 * row.n),
          by_(4 * n_whole), derivative_(3 * n_whole) {}

    INLINE int n_linear() const { return 3 * row_.n; }
    INLINE int n_theta() const { return n_free_; }

    INLINE void set_basis(const double* theta, Rows& out) {
        set_free(theta);
        const int d = row_.n;
        for (long s = 0; s < samples_.n; ++s) {
            steady_basis(whole_.data(), row_, samples_, s, long(clocks_[s]), unit_.data());
            for (int a = 0; a < 3; ++a) {
                const double* unit = unit_.data() + a * 3 * d;
                double* row = out.row(int(3 * s + a));
                for (int j = 0; j < d; ++j)
                    for (int b = 0; b < 3; ++b) {
                        row[3 * j + b] = 0.0;
                        for (int i = 0; i < d; ++i)
                            row[3 * j + b] += unit[3 * i + b] * combinations_[i * d + j];
                    }
            }
        }
    }

    INLINE void set_derivative(const double* theta, const double* p, Rows& out) {
        set_free(theta);
        const int d = row_.n, n_whole = int(whole_.size());
        for (int i = 0; i < d; ++i)
            for (int b = 0; b < 3; ++b) {
                moments_[3 * i + b] = 0.0;
                for (int j = 0; j < d; ++j)
                    moments_[3 * i + b] += combinations_[i * d + j] * p[3 * j + b];
            }
        for (long s = 0; s < samples_.n; ++s) {
            steady_derivative(whole_.data(), n_whole, moments_.data(), row_, samples_, s,
                              long(clocks_[s]), by_.data(), derivative_.data());
            for (int a = 0; a < 3; ++a)
                for (int c = 0; c < n_free_; ++c)
                    out.row(int(3 * s + a))[c] = derivative_[a * n_whole + free_[c]];
        }
    }

  private:
    // Copies the free parameters into the whole parameter vector.
    INLINE void set_free(const double* theta) {
        for (int c = 0; c < n_free_; ++c) whole_[free_[c]] = theta[c];
    }

    Row row_;
    const double* combinations_;
    Samples samples_;
    const std::int64_t *clocks_, *free_;
    int n_free_;
    std::vector<double> whole_, unit_, moments_, by_, derivative_;
};

// Refines each of `n` starts theta (n, n_free) in place. The outputs are cost (n) and covariance
// (n, n_free, n_free).
FOR_PROCESSORS static void fit_steady(SteadyModel& model, const double* y, Rows& nuisance,
                                      const SearchLimits& limits, long n, double* theta,
                                      double* cost, double* covariance) {
    SeparableFit<SteadyModel> fit(model, y, nuisance, limits);
    const long k = model.n_theta();
    for (long p = 0; p < n; ++p) cost[p] = fit.refine(theta + p * k, covariance + p * k * k);
}

}  // namespace mag_tracking
