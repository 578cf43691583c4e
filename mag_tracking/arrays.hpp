// Types shared by all compiled code: SIMD vectors, aligned arrays and sparse motion Jacobians.

#pragma once

#include <cstddef>
#include <memory>
#include <new>

// Functions called from a FOR_PROCESSORS function must be inlined to be compiled for its targets.
#define INLINE inline __attribute__((always_inline))

namespace mag_tracking {

// SIMD vector of eight doubles; the compiler emulates it on processors without such registers.
using Eight = double __attribute__((vector_size(64), may_alias));
constexpr int EIGHT = 8;

// Array of doubles, aligned for vectors of eight and initialised to zero.
class Numbers {
  public:
    explicit Numbers(std::size_t n = 0)
        : data_(new (std::align_val_t(sizeof(Eight))) double[n + EIGHT]()) {}
    INLINE double* data() { return data_.get(); }
    INLINE double& operator[](std::size_t i) { return data_.get()[i]; }

  private:
    struct Delete {
        void operator()(double* p) const {
            ::operator delete[](p, std::align_val_t(sizeof(Eight)));
        }
    };
    std::unique_ptr<double[], Delete> data_;
};

INLINE Eight* eights(double* p) { return reinterpret_cast<Eight*>(p); }
INLINE const Eight* eights(const double* p) { return reinterpret_cast<const Eight*>(p); }

// Maximum number of moving states per target, and of targets in a joint state.
constexpr int MAX_MOVING = 6, MAX_TARGETS = 4, MAX_ROWS = MAX_MOVING * MAX_TARGETS;

// Motion of the targets and the rows of its Jacobian that differ from identity: `n` rows, each with
// `width` columns that may be non-zero.
struct Motion {
    int n, width;
    int rows[MAX_ROWS];
    int columns[MAX_ROWS][MAX_MOVING];
    double f[MAX_ROWS][MAX_MOVING];
    double moved[MAX_ROWS];  // Predicted states of the rows.
};

}  // namespace mag_tracking
