// What all compiled code shares: vectors of numbers, and the form of a motion's Jacobian.

#pragma once

#include <cstddef>
#include <memory>
#include <new>

// What is called from a function for several processors has to become part of it.
#define INLINE inline __attribute__((always_inline))

namespace mag_tracking {

// Eight numbers that are computed with at once, on any processor.
using Eight = double __attribute__((vector_size(64), may_alias));
constexpr int EIGHT = 8;

// Numbers that begin where vectors of eight may; zero at first.
class Numbers {
  public:
    explicit Numbers(std::size_t n = 0)
        : data_(new (std::align_val_t(sizeof(Eight))) double[n + EIGHT]()) {}
    INLINE double* data() { return data_.get(); }
    INLINE double& operator[](std::size_t i) { return data_.get()[i]; }

  private:
    struct Delete {
        void operator()(double* p) const { ::operator delete[](p, std::align_val_t(sizeof(Eight))); }
    };
    std::unique_ptr<double[], Delete> data_;
};

INLINE Eight* eights(double* p) { return reinterpret_cast<Eight*>(p); }
INLINE const Eight* eights(const double* p) { return reinterpret_cast<const Eight*>(p); }

// Of one target as many states move at most, and so many targets share a state at most.
constexpr int MAX_MOVING = 6, MAX_TARGETS = 4, MAX_ROWS = MAX_MOVING * MAX_TARGETS;

// A move of the targets, and its Jacobian where that is not the one of identity: in `n` rows, each
// of which has `width` columns that may differ from zero.
struct Motion {
    int n, width;
    int rows[MAX_ROWS];
    int columns[MAX_ROWS][MAX_MOVING];
    double f[MAX_ROWS][MAX_MOVING];
    double moved[MAX_ROWS];  // The states of the rows.
};

}  // namespace mag_tracking
