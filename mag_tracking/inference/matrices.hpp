// Inverses and pseudo-inverses of small symmetric matrices (matrices.py).

#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace mag_tracking {

// Inverse of symmetric matrices of one size.
class Inverter {
  public:
    explicit Inverter(std::size_t n) : n_(n), scale_(n), L_(n * n), inverse_(n * n) {}

    // Writes the inverse of `A` (n, n), scaled to unit diagonal first, to `out`. Returns false if
    // the root of a pivot is not above `least`.
    bool invert(const double* A, double least, double* out) {
        for (std::size_t i = 0; i < n_; ++i)
            scale_[i] = A[i * n_ + i] > 0.0 ? 1.0 / std::sqrt(A[i * n_ + i]) : 1.0;
        if (!factor(A, least)) return false;
        invert_factor();
        for (std::size_t i = 0; i < n_; ++i)
            for (std::size_t k = 0; k <= i; ++k) {
                double sum = 0.0;
                for (std::size_t m = i; m < n_; ++m)
                    sum += inverse_[m * n_ + i] * inverse_[m * n_ + k];
                out[i * n_ + k] = out[k * n_ + i] = sum * scale_[i] * scale_[k];
            }
        return true;
    }

  private:
    // Cholesky factor L of the scaled matrix.
    bool factor(const double* A, double least) {
        for (std::size_t i = 0; i < n_; ++i)
            for (std::size_t k = 0; k <= i; ++k) {
                double rest = A[i * n_ + k] * scale_[i] * scale_[k];
                for (std::size_t m = 0; m < k; ++m) rest -= L_[i * n_ + m] * L_[k * n_ + m];
                if (k < i) {
                    L_[i * n_ + k] = rest / L_[k * n_ + k];
                } else {
                    // The negation also catches NaN.
                    if (!(rest > least * least) || !std::isfinite(rest)) return false;
                    L_[i * n_ + i] = std::sqrt(rest);
                }
            }
        return true;
    }

    void invert_factor() {
        for (std::size_t i = 0; i < n_; ++i) {
            inverse_[i * n_ + i] = 1.0 / L_[i * n_ + i];
            for (std::size_t k = 0; k < i; ++k) {
                double sum = 0.0;
                for (std::size_t m = k; m < i; ++m) sum -= L_[i * n_ + m] * inverse_[m * n_ + k];
                inverse_[i * n_ + k] = sum * inverse_[i * n_ + i];
            }
        }
    }

    std::size_t n_;
    std::vector<double> scale_, L_, inverse_;
};

// Eigenvalues and eigenvectors of symmetric matrices of one size, by the cyclic Jacobi method.
//
// Golub and Van Loan 1996, Matrix Computations, section 8.4.
class Eigen {
  public:
    explicit Eigen(std::size_t n) : vectors(n * n), n_(n) {}

    // Decomposes `A` (n, n) in place; the eigenvalues are on its diagonal afterwards.
    void solve(double* A) {
        std::fill(vectors.begin(), vectors.end(), 0.0);
        for (std::size_t i = 0; i < n_; ++i) vectors[i * n_ + i] = 1.0;
        for (int sweep = 0; sweep < MAX_SWEEPS && !is_diagonal(A); ++sweep)
            for (std::size_t p = 0; p + 1 < n_; ++p)
                for (std::size_t q = p + 1; q < n_; ++q)
                    if (A[p * n_ + q] != 0.0) rotate(A, p, q);
    }

    std::vector<double> vectors;  // (n, n) eigenvectors in columns.

  private:
    // Far more than needed: convergence is quadratic.
    static constexpr int MAX_SWEEPS = 30;

    bool is_diagonal(const double* A) const {
        double on = 0.0, off = 0.0;
        for (std::size_t i = 0; i < n_; ++i)
            for (std::size_t k = 0; k < n_; ++k)
                (i == k ? on : off) += A[i * n_ + k] * A[i * n_ + k];
        return off <= 1e-32 * on;
    }

    // Rotates the elements (p, q) and (q, p) to zero.
    void rotate(double* A, std::size_t p, std::size_t q) {
        const double slope = (A[q * n_ + q] - A[p * n_ + p]) / (2.0 * A[p * n_ + q]);
        const double t = (slope >= 0.0 ? 1.0 : -1.0)
                         / (std::abs(slope) + std::sqrt(1.0 + slope * slope));
        const double c = 1.0 / std::sqrt(1.0 + t * t), s = t * c;
        for (std::size_t i = 0; i < n_; ++i) turn(A[i * n_ + p], A[i * n_ + q], c, s);
        for (std::size_t i = 0; i < n_; ++i) turn(A[p * n_ + i], A[q * n_ + i], c, s);
        for (std::size_t i = 0; i < n_; ++i) turn(vectors[i * n_ + p], vectors[i * n_ + q], c, s);
        A[p * n_ + q] = A[q * n_ + p] = 0.0;
    }

    static void turn(double& a, double& b, double c, double s) {
        const double before = a;
        a = c * a - s * b;
        b = s * before + c * b;
    }

    std::size_t n_;
};

// `matrices.pseudo_inverse` for matrices of one size, one at a time.
class PseudoInverter {
  public:
    // Matrices that `Inverter` inverts with `least` have full rank. For other matrices, directions
    // with an eigenvalue below the fraction `rank` of the largest are excluded.
    PseudoInverter(std::size_t n, double least, double rank)
        : n_(n), least_(least), rank_(rank), inverter_(n), eigen_(n), unit_(n * n), scale_(n) {}

    // Writes the pseudo-inverse of `A` (n, n) to `out`; NaN if `A` is not finite.
    void invert(const double* A, double* out) {
        if (inverter_.invert(A, least_, out)) return;
        if (!std::all_of(A, A + n_ * n_, [](double a) { return std::isfinite(a); })) {
            std::fill(out, out + n_ * n_, std::numeric_limits<double>::quiet_NaN());
            return;
        }
        for (std::size_t i = 0; i < n_; ++i)
            scale_[i] = A[i * n_ + i] > 0.0 ? 1.0 / std::sqrt(A[i * n_ + i]) : 1.0;
        for (std::size_t i = 0; i < n_; ++i)
            for (std::size_t k = 0; k < n_; ++k)
                unit_[i * n_ + k] = A[i * n_ + k] * (scale_[i] * scale_[k]);
        eigen_.solve(unit_.data());
        double largest = unit_[0];
        for (std::size_t i = 1; i < n_; ++i) largest = std::max(largest, unit_[i * n_ + i]);
        std::fill(out, out + n_ * n_, 0.0);
        for (std::size_t m = 0; m < n_; ++m)
            if (unit_[m * n_ + m] > rank_ * largest) add(m, out);
    }

  private:
    // Adds the contribution of eigenvector `m` to the inverse.
    void add(std::size_t m, double* out) {
        const double* V = eigen_.vectors.data();
        for (std::size_t i = 0; i < n_; ++i)
            for (std::size_t k = 0; k < n_; ++k)
                out[i * n_ + k] += V[i * n_ + m] * V[k * n_ + m] / unit_[m * n_ + m]
                                   * (scale_[i] * scale_[k]);
    }

    std::size_t n_;
    double least_, rank_;
    Inverter inverter_;
    Eigen eigen_;
    std::vector<double> unit_, scale_;
};

}  // namespace mag_tracking
