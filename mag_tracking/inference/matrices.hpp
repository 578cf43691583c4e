// Inverses of small symmetric matrices (matrices.py).

#pragma once

#include <cmath>
#include <cstddef>
#include <vector>

namespace mag_tracking {

// Inverts symmetric matrices of one size.
class Inverter {
  public:
    explicit Inverter(std::size_t n) : n_(n), scale_(n), L_(n * n), inverse_(n * n) {}

    // Inverse of `A` (n, n), scaled to unit diagonal first, into `out`. False where a root of a
    // pivot is then not larger than `least`.
    bool invert(const double* A, double least, double* out) {
        for (std::size_t i = 0; i < n_; ++i)
            scale_[i] = A[i * n_ + i] > 0.0 ? 1.0 / std::sqrt(A[i * n_ + i]) : 1.0;
        if (!factor(A, least)) return false;
        invert_factor();
        for (std::size_t i = 0; i < n_; ++i)
            for (std::size_t k = 0; k <= i; ++k) {
                double sum = 0.0;
                for (std::size_t m = i; m < n_; ++m) sum += inverse_[m * n_ + i] * inverse_[m * n_ + k];
                out[i * n_ + k] = out[k * n_ + i] = sum * scale_[i] * scale_[k];
            }
        return true;
    }

  private:
    // The scaled matrix is L L'.
    bool factor(const double* A, double least) {
        for (std::size_t i = 0; i < n_; ++i)
            for (std::size_t k = 0; k <= i; ++k) {
                double rest = A[i * n_ + k] * scale_[i] * scale_[k];
                for (std::size_t m = 0; m < k; ++m) rest -= L_[i * n_ + m] * L_[k * n_ + m];
                if (k < i) {
                    L_[i * n_ + k] = rest / L_[k * n_ + k];
                } else {
                    // Also where it is no number.
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

}  // namespace mag_tracking
