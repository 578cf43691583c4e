// Non-linear least squares by variable projection, from one starting point (least_squares.py).

#pragma once

#include <cmath>
#include <cstring>
#include <limits>
#include <utility>
#include <vector>

#include "../arrays.hpp"
#include "matrices.hpp"

namespace mag_tracking {

// Stopping criteria of a search and tolerances of its pseudo-inverses, as in least_squares.py.
struct SearchLimits {
    int n_steps;
    double tolerance, max_damping, full_rank, linear_rank, rank;
};

// Matrix (n, k) with rows padded by zeros to a multiple of eight.
struct Rows {
    int n, k, n_eights;
    Numbers numbers;

    Rows(int n_, int k_)
        : n(n_), k(k_), n_eights((k_ + EIGHT - 1) / EIGHT),
          numbers(std::size_t(n_) * n_eights * EIGHT) {}

    INLINE int wide() const { return n_eights * EIGHT; }
    INLINE double* row(int i) { return numbers.data() + std::size_t(i) * wide(); }
    INLINE Eight* of_row(int i) { return eights(row(i)); }
    INLINE void clear() {
        std::memset(numbers.data(), 0, std::size_t(n) * wide() * sizeof(double));
    }
};

// out = A' B, with out (A.k, B.k).
INLINE void set_product(Rows& A, Rows& B, Rows& out) {
    out.clear();
    for (int i = 0; i < A.n; ++i) {
        const double* a = A.row(i);
        const Eight* b = B.of_row(i);
        for (int c = 0; c < A.k; ++c)
            for (int v = 0; v < B.n_eights; ++v) out.of_row(c)[v] += a[c] * b[v];
    }
}

// A -= B X.
INLINE void subtract_product(Rows& A, Rows& B, Rows& X) {
    for (int i = 0; i < A.n; ++i) {
        const double* b = B.row(i);
        Eight* a = A.of_row(i);
        for (int c = 0; c < B.k; ++c)
            for (int v = 0; v < A.n_eights; ++v) a[v] -= b[c] * X.of_row(c)[v];
    }
}

// Fits measurements y (n_y), from which `nuisance` (n_y, q) with orthonormal columns has been
// projected out. A `Model` writes its basis (n_y, n_linear) for theta (n_theta), and the derivative
// (n_y, n_theta) with respect to theta for linear parameters p (n_linear).
template <class Model>
class SeparableFit {
  public:
    SeparableFit(Model& model, const double* y, Rows& nuisance, const SearchLimits& limits)
        : model_(model), y_(y), nuisance_(nuisance), limits_(limits), n_y_(nuisance.n),
          n_theta_(model.n_theta()), basis_(n_y_, model.n_linear()),
          of_basis_(nuisance.k, model.n_linear()), of_derivative_(nuisance.k, n_theta_),
          normal_(model.n_linear(), model.n_linear()), by_basis_(model.n_linear(), n_theta_),
          correction_(model.n_linear(), n_theta_), information_(n_theta_, n_theta_),
          linear_(model.n_linear(), limits.full_rank, limits.linear_rank),
          steps_(n_theta_, limits.full_rank, limits.rank), p_(model.n_linear()) {}

    // Levenberg-Marquardt from `theta`, in place. Writes the pseudo-inverse of the information to
    // `covariance` (n_theta, n_theta). Returns the cost, infinite for an unusable start.
    INLINE double refine(double* theta, double* covariance) {
        Point here(n_y_, n_theta_), trial(n_y_, n_theta_);
        std::vector<double> A(n_theta_ * n_theta_), inverse(A), step(n_theta_);
        here.theta.assign(theta, theta + n_theta_);
        evaluate(here);
        double damping = 1e-3;
        for (int k = 0; k < limits_.n_steps && std::isfinite(here.cost); ++k) {
            set_information(here, damping, A.data());
            steps_.invert(A.data(), inverse.data());
            bool done = true;
            for (int i = 0; i < n_theta_; ++i) {
                step[i] = 0.0;
                for (int m = 0; m < n_theta_; ++m)
                    step[i] += inverse[i * n_theta_ + m] * here.gradient[m];
                done &= std::abs(step[i]) <= 1e-10 * std::abs(here.theta[i]);
                trial.theta[i] = here.theta[i] + step[i];
            }
            evaluate(trial);
            const bool better = trial.cost < here.cost;
            done |= better && here.cost - trial.cost <= limits_.tolerance * here.cost;
            damping *= better ? 0.2 : 5.0;
            if (better) std::swap(here, trial);
            if (done || !(damping < limits_.max_damping)) break;
        }
        set_information(here, 0.0, A.data());
        steps_.invert(A.data(), covariance);
        std::copy(here.theta.begin(), here.theta.end(), theta);
        return here.cost;
    }

  private:
    struct Point {
        std::vector<double> theta, residual, gradient;
        Rows J;
        double cost = 0.0;

        Point(int n_y, int n) : theta(n), residual(n_y), gradient(n), J(n_y, n) {}
    };

    // Evaluates residuals, derivative and cost at a theta; an unusable point has infinite cost.
    INLINE void evaluate(Point& at) {
        model_.set_basis(at.theta.data(), basis_);
        project(basis_, of_basis_);
        set_product(basis_, basis_, normal_);
        const int k = basis_.k;
        std::vector<double> N(k * k), inverse(N), by_y(k);
        for (int i = 0; i < k; ++i) std::copy(normal_.row(i), normal_.row(i) + k, N.data() + i * k);
        linear_.invert(N.data(), inverse.data());
        for (int i = 0; i < n_y_; ++i)
            for (int c = 0; c < k; ++c) by_y[c] += y_[i] * basis_.row(i)[c];
        for (int i = 0; i < k; ++i) {
            p_[i] = 0.0;
            for (int c = 0; c < k; ++c) p_[i] += inverse[i * k + c] * by_y[c];
        }
        at.cost = 0.0;
        for (int i = 0; i < n_y_; ++i) {
            double rest = y_[i];
            for (int c = 0; c < k; ++c) rest -= basis_.row(i)[c] * p_[c];
            at.residual[i] = rest;
            at.cost += rest * rest;
        }
        set_jacobian(at, inverse.data());
    }

    INLINE void set_jacobian(Point& at, const double* inverse) {
        model_.set_derivative(at.theta.data(), p_.data(), at.J);
        project(at.J, of_derivative_);
        // Kaufman's approximation: project out what the linear parameters compensate.
        set_product(basis_, at.J, by_basis_);
        correction_.clear();
        for (int i = 0; i < basis_.k; ++i)
            for (int c = 0; c < basis_.k; ++c)
                for (int v = 0; v < at.J.n_eights; ++v)
                    correction_.of_row(i)[v] += inverse[i * basis_.k + c] * by_basis_.of_row(c)[v];
        subtract_product(at.J, basis_, correction_);
        double total = 0.0;
        at.gradient.assign(n_theta_, 0.0);
        for (int i = 0; i < n_y_; ++i)
            for (int c = 0; c < n_theta_; ++c) {
                total += at.J.row(i)[c];
                at.gradient[c] += at.J.row(i)[c] * at.residual[i];
            }
        if (std::isfinite(at.cost) && std::isfinite(total)) return;
        at.cost = std::numeric_limits<double>::infinity();
        at.gradient.assign(n_theta_, 0.0);
        at.J.clear();
    }

    // J' J, with its diagonal increased by the fraction `damping` (Marquardt's scaling).
    INLINE void set_information(Point& at, double damping, double* out) {
        set_product(at.J, at.J, information_);
        for (int i = 0; i < n_theta_; ++i) {
            std::copy(information_.row(i), information_.row(i) + n_theta_, out + i * n_theta_);
            out[i * n_theta_ + i] += damping * out[i * n_theta_ + i];
        }
    }

    // Projects the nuisance terms out of A; `scratch` is overwritten.
    INLINE void project(Rows& A, Rows& scratch) {
        set_product(nuisance_, A, scratch);
        subtract_product(A, nuisance_, scratch);
    }

    Model& model_;
    const double* y_;
    Rows& nuisance_;
    SearchLimits limits_;
    int n_y_, n_theta_;
    Rows basis_, of_basis_, of_derivative_, normal_, by_basis_, correction_, information_;
    PseudoInverter linear_, steps_;
    std::vector<double> p_;
};

}  // namespace mag_tracking
