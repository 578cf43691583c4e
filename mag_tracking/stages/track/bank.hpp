// Update of a bank with a frame, and filtering along the paths of a bank, for each target type.

#pragma once

#include "../../physics/targets.hpp"
#include "../../processors.hpp"
#include "filter.hpp"

namespace mag_tracking {

struct Bank {
    int n_hyp, n_targets;
    const double *near_field_length, *x, *P;

    // Near-field lengths (n_targets) of hypothesis p.
    INLINE const double* lengths(int p) const { return near_field_length + p * n_targets; }
};

// Output of an update. It may alias the bank, because each hypothesis is completed before the next
// one is read.
struct Advanced {
    double *x, *P, *predicted, *log_likelihood, *nis;
};

// Parameters and outputs of `run_along`.
struct Along {
    bool first_is_updated;
    double max_nis;
    int iterations, passes;
    double step;
    double *paths, *log_likelihood, *max_shift, *covariances;
    bool* used;
};

template <class Target>
INLINE void advance_all(const Target& target, const Sensors& sensors, const Sizes& n,
                        const Frame& frame, bool moves, int iterations, const Bank& bank,
                        const Advanced& out) {
    Filter<Target> filter(target, sensors, n);
    Path scratch(1, n);
    Numbers x(n.wide), P(n.square()), x_lin(n.wide), prior(iterations > 1 ? n.square() : 0);
    const int n_x = n.n_x;
    const std::size_t square = std::size_t(n_x) * n_x;
    for (int p = 0; p < bank.n_hyp; ++p) {
        const double* before = bank.x + p * n_x;
        double* predicted = out.predicted + p * n_x;
        std::copy(before, before + n_x, x.data());
        to_wide(bank.P + p * square, n, P.data());
        if (moves) filter.predict(frame, before, x.data(), P.data(), scratch.motion[0]);
        std::copy(x.data(), x.data() + n_x, predicted);
        for (int k = 0; k < iterations; ++k) {
            std::copy(x.data(), x.data() + n_x, x_lin.data());
            if (k) {
                std::copy(predicted, predicted + n_x, x.data());
                std::memcpy(P.data(), prior.data(), n.square() * sizeof(double));
            } else if (iterations > 1) {
                std::memcpy(prior.data(), P.data(), n.square() * sizeof(double));
            }
            out.log_likelihood[p] =
                filter.update(frame, x_lin.data(), bank.lengths(p), x.data(), P.data(),
                              scratch.gains(0, n), out.nis + p * n.n_sensors);
        }
        std::copy(x.data(), x.data() + n_x, out.x + p * n_x);
        from_wide(P.data(), n, out.P + p * square);
    }
}

// Largest distance between smoothed positions and a path `at`, both (n, n_x), in units of the
// standard deviations `deviation` (n). NaN propagates: such a path has not converged.
INLINE double farthest(const double* smoothed, const double* at, const double* deviation, int n,
                       int n_x) {
    double farthest = 0.0;
    for (int k = 0; k < n; ++k) {
        double square = 0.0;
        for (int i = 0; i < 3; ++i) {
            const double moved = smoothed[k * n_x + i] - at[k * n_x + i];
            square += moved * moved;
        }
        const double moved = std::sqrt(square) / deviation[k];
        if (!(moved <= farthest) && !std::isnan(farthest)) farthest = moved;
    }
    return farthest;
}

template <class Target>
INLINE void run_along_all(const Target& target, const Sensors& sensors, const Sizes& n,
                          const Frames& frames, const Bank& bank, const Along& along,
                          const Advanced& out) {
    Filter<Target> filter(target, sensors, n);
    Path path(frames.n, n);
    const int n_x = n.n_x;
    const std::size_t square = std::size_t(n_x) * n_x;
    Numbers x(n.wide), P(n.square());
    std::vector<double> smoothed(frames.n * n_x), std(frames.n);
    for (int p = 0; p < bank.n_hyp; ++p) {
        double* at = along.paths + std::size_t(p) * frames.n * n_x;
        for (int pass = 0; pass < along.passes; ++pass) {
            std::copy(bank.x + p * n_x, bank.x + (p + 1) * n_x, x.data());
            to_wide(bank.P + p * square, n, P.data());
            along.log_likelihood[p] =
                filter.run(frames, along.first_is_updated, along.max_nis, along.iterations,
                           bank.lengths(p), at, x.data(), P.data(), path);
            if (!filter.smooth(frames, path, smoothed.data(), std.data()))
                along.log_likelihood[p] = -std::numeric_limits<double>::infinity();
            along.max_shift[p] = farthest(smoothed.data(), at, std.data(), frames.n, n_x);
            for (int i = 0; i < frames.n * n_x; ++i)
                at[i] = std::isnan(at[i]) ? smoothed[i]
                                          : at[i] + along.step * (smoothed[i] - at[i]);
        }
        std::copy(x.data(), x.data() + n_x, out.x + p * n_x);
        from_wide(P.data(), n, out.P + p * square);
        if (along.covariances != nullptr)
            filter.smooth_covariances(frames, path, along.covariances + p * frames.n * square);
        if (along.used != nullptr)
            std::copy(path.used.begin(), path.used.end(), along.used + p * frames.n);
    }
}

// Function multiversioning does not work with templates, so each target type has its functions.
[[maybe_unused]]
FOR_PROCESSORS static void advance(const RowVehicle& target, const Sensors& sensors, const Sizes& n,
                                   const Frame& frame, bool moves, int iterations, const Bank& bank,
                                   const Advanced& out) {
    advance_all(target, sensors, n, frame, moves, iterations, bank, out);
}

[[maybe_unused]]
FOR_PROCESSORS static void advance(const Vehicles& target, const Sensors& sensors, const Sizes& n,
                                   const Frame& frame, bool moves, int iterations, const Bank& bank,
                                   const Advanced& out) {
    advance_all(target, sensors, n, frame, moves, iterations, bank, out);
}

[[maybe_unused]]
FOR_PROCESSORS static void advance(const Magnet& target, const Sensors& sensors, const Sizes& n,
                                   const Frame& frame, bool moves, int iterations, const Bank& bank,
                                   const Advanced& out) {
    advance_all(target, sensors, n, frame, moves, iterations, bank, out);
}

[[maybe_unused]]
FOR_PROCESSORS static void run_along(const RowVehicle& target, const Sensors& sensors,
                                     const Sizes& n, const Frames& frames, const Bank& bank,
                                     const Along& along, const Advanced& out) {
    run_along_all(target, sensors, n, frames, bank, along, out);
}

[[maybe_unused]]
FOR_PROCESSORS static void run_along(const Vehicles& target, const Sensors& sensors, const Sizes& n,
                                     const Frames& frames, const Bank& bank, const Along& along,
                                     const Advanced& out) {
    run_along_all(target, sensors, n, frames, bank, along, out);
}

[[maybe_unused]]
FOR_PROCESSORS static void run_along(const Magnet& target, const Sensors& sensors, const Sizes& n,
                                     const Frames& frames, const Bank& bank, const Along& along,
                                     const Advanced& out) {
    run_along_all(target, sensors, n, frames, bank, along, out);
}

}  // namespace mag_tracking
