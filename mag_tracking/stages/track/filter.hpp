// Extended Kalman filter and smoother of one hypothesis, for a single frame and for a whole path.
//
// Each hypothesis is completed before the next one, while its covariance is in the cache. The same
// code serves the running bank, relinearised paths and smoothing.

#pragma once

#include <vector>

#include "../../inference/hypothesis.hpp"

namespace mag_tracking {

constexpr int MAX_TARGET_STATES = 256;

// The sensors of a network.
struct Sensors {
    int n_angles, n_errors;   // States of each sensor: mounting angles, and model errors.
    const double* positions;  // (n_sensors, 3) [m], world frame.
    const double* R_sw;       // (n_sensors, 3, 3) rotation from world to sensor.
    double field_error;
};

// One frame.
struct Frame {
    const double* field;       // (n_sensors, 3) [T]; NaN for a missing axis.
    const double* covariance;  // (n_sensors, 3, 3) [T^2], without NaN.
    const double* offset;      // (n_sensors) [s] time of the samples, relative to the frame.
    double dt;                 // [s] time since the previous frame.
    const double* decay;       // (n_x - n_t) factor of the sensors' states over this time.
    const double* variance;    // (n_x - n_t) process noise added to their variance.
};

// Consecutive frames, stored one after the other.
struct Frames {
    int n;
    const double *field, *covariance, *offset, *dt, *decay, *variance;

    INLINE Frame at(int k, const Sizes& n) const {
        const int own = n.n_x - n.n_t;
        return {field + k * n.n_sensors * 3,
                covariance + k * n.n_sensors * 9,
                offset + k * n.n_sensors,
                dt[k],
                decay + k * own,
                variance + k * own};
    }
};

// States, covariances and gains of a hypothesis in each frame, for the smoother.
struct Path {
    Numbers x, P, H, G, z, W;
    std::vector<Motion> motion;
    std::vector<char> used;  // Whether there was an update.

    Path(int n, const Sizes& s)
        : x(n * s.wide), P(n * s.square()), H(n * s.n_sensors * 3 * s.n_seen()),
          G(n * s.n_sensors * 3 * s.wide), z(n * s.n_sensors * 3), W(n * s.n_sensors * 6),
          motion(n), used(n) {}

    INLINE Gains gains(int k, const Sizes& s) {
        return {H.data() + k * s.n_sensors * 3 * s.n_seen(),
                G.data() + k * s.n_sensors * 3 * s.wide, z.data() + k * s.n_sensors * 3,
                W.data() + k * s.n_sensors * 6};
    }
};

template <class Target>
class Filter {
  public:
    Filter(const Target& target, const Sensors& sensors, const Sizes& sizes)
        : target_(target), sensors_(sensors), n_(sizes), Q_(sizes.n_t * sizes.wide),
          T_(MAX_ROWS * sizes.wide), h_(3 * sizes.n_sensors), inflation_(sizes.n_sensors),
          x_lin_(sizes.wide) {}

    // Time update of `x` (wide) and `P` (n_x, wide), linearised at `at` (n_x). No process noise is
    // added backwards in time.
    INLINE void predict(const Frame& frame, const double* at, double* x, double* P,
                        Motion& motion) {
        target_.move(at, frame.dt, motion);
        if (frame.dt > 0.0) target_.noise(at, P, n_.wide, frame.dt, motion, Q_.data());
        double moved[MAX_ROWS];
        for (int r = 0; r < motion.n; ++r) {
            moved[r] = motion.moved[r];
            for (int m = 0; m < motion.width; ++m) {
                const int c = motion.columns[r][m];
                moved[r] += motion.f[r][m] * (x[c] - at[c]);
            }
        }
        for (int r = 0; r < motion.n; ++r) x[motion.rows[r]] = moved[r];
        move_covariance(P, n_, motion, T_.data());
        drift(x, P, n_, frame.decay, frame.variance);
        if (frame.dt > 0.0)
            for (int a = 0; a < n_.n_t; ++a)
                for (int v = 0; v * EIGHT < n_.n_t; ++v)
                    eights(P + a * n_.wide)[v] += eights(Q_.data() + a * n_.wide)[v];
    }

    // Measurement update linearised at `x_lin` (n_x); returns its log-likelihood.
    // `near_field_length` has one value per target. The outputs are the gains and the normalised
    // innovation squared `nis` of each sensor.
    INLINE double update(const Frame& frame, const double* x_lin, const double* near_field_length,
                         double* x, double* P, const Gains& gains, double* nis) {
        const bool is_lost = !evaluate(frame, x_lin, near_field_length, gains.H);
        if (is_lost) {
            // A dipole is at a sensor: the hypothesis gets zero likelihood.
            std::fill(h_.data(), h_.data() + 3 * n_.n_sensors, 0.0);
            std::fill(inflation_.data(), inflation_.data() + n_.n_sensors, 0.0);
            std::fill(gains.H, gains.H + n_.n_sensors * 3 * n_.n_seen(), 0.0);
        }
        double log_likelihood = 0.0;
        for (int j = 0; j < n_.n_sensors; ++j)
            nis[j] = update_by_sensor(x, P, x_lin, frame.field + 3 * j, frame.covariance + 9 * j,
                                      h_.data() + 3 * j, gains.H + j * 3 * n_.n_seen(),
                                      inflation_[j], n_, j, gains.G + j * 3 * n_.wide,
                                      gains.z + 3 * j, gains.W + 6 * j, log_likelihood);
        complete(P, n_);
        return is_lost ? -std::numeric_limits<double>::infinity() : log_likelihood;
    }

    // Filters a hypothesis, `x` (wide) and `P` (n_x, wide), through all frames; returns the
    // log-likelihood. The linearisation points are `path` (n, n_x). NaN linearises at the
    // prediction, and repeats the update at its own result, `iterations` times in total. A frame
    // whose normalised innovation squared exceeds `max_nis` per axis is not used for an update.
    INLINE double run(const Frames& frames, bool first_is_updated, double max_nis, int iterations,
                      const double* near_field_length, const double* path, double* x, double* P,
                      Path& out) {
        double total = 0.0;
        std::vector<double> nis(n_.n_sensors);
        const bool leaves_out = std::isfinite(max_nis), goes_back = leaves_out || iterations > 1;
        Numbers prior_x(n_.wide), prior_P(goes_back ? n_.square() : 0);
        for (int k = 0; k < frames.n; ++k) {
            const Frame frame = frames.at(k, n_);
            if (k) predict(frame, linearised_at(path + (k - 1) * n_.n_x, x), x, P, out.motion[k]);
            out.used[k] = k || !first_is_updated;
            if (out.used[k]) {
                if (goes_back) copy(x, P, prior_x.data(), prior_P.data());
                const double* at = path + k * n_.n_x;
                double of_frame = 0.0;
                for (int i = 0; i < (std::isnan(at[0]) ? iterations : 1); ++i) {
                    const double* x_lin = linearised_at(at, x);
                    if (i) copy(prior_x.data(), prior_P.data(), x, P);
                    of_frame = update(frame, x_lin, near_field_length, x, P, out.gains(k, n_),
                                      nis.data());
                }
                if (leaves_out && is_implausible(frame.field, nis, max_nis)) {
                    copy(prior_x.data(), prior_P.data(), x, P);
                    out.used[k] = false;
                } else {
                    total += of_frame;
                }
            }
            copy(x, P, out.x.data() + k * n_.wide, out.P.data() + k * n_.square());
        }
        return total;
    }

    // Smoothed states (n, n_x), and the standard deviation (n) of the filtered position. Returns
    // false if a variance is negative.
    INLINE bool smooth(const Frames& frames, Path& path, double* smoothed, double* std) {
        bool is_valid = true;
        Numbers after(n_.wide), moved(n_.wide);
        for (int k = frames.n - 1; k >= 0; --k) {
            const double* P = path.P.data() + k * n_.square();
            for (int v = 0; v < n_.n_eights; ++v) {
                Eight sum = eights(path.x.data() + k * n_.wide)[v];
                for (int m = 0; m < n_.n_x; ++m) sum += after[m] * eights(P + m * n_.wide)[v];
                eights(moved.data())[v] = sum;
            }
            std::copy(moved.data(), moved.data() + n_.n_x, smoothed + k * n_.n_x);
            const double variance = P[0] + P[n_.wide + 1] + P[2 * n_.wide + 2];
            is_valid &= variance >= 0.0;
            std[k] = std::sqrt(variance);
            if (path.used[k]) before_update(after.data(), n_, path.gains(k, n_));
            if (k) before_move(after.data(), n_, path.motion[k], frames.at(k, n_).decay);
        }
        return is_valid;
    }

    // Smoothed covariances (n, n_x, n_x): P - P L P, with the information L of the later frames.
    INLINE void smooth_covariances(const Frames& frames, Path& path, double* out) {
        const int n_x = n_.n_x;
        Numbers information(n_.square()), once(n_.square()), twice(n_.square()), B(3 * n_.wide);
        for (int k = frames.n - 1; k >= 0; --k) {
            const double* P = path.P.data() + k * n_.square();
            double* C = out + std::size_t(k) * n_x * n_x;
            multiply(information.data(), P, once.data());
            multiply(P, once.data(), twice.data());
            for (int i = 0; i < n_x; ++i)
                for (int m = 0; m <= i; ++m) {
                    const int a = i * n_.wide + m, b = m * n_.wide + i;
                    C[i * n_x + m] = C[m * n_x + i] = 0.5 * (P[a] + P[b] - twice[a] - twice[b]);
                }
            if (path.used[k])
                information_before_update(information.data(), n_, path.gains(k, n_),
                                          frames.at(k, n_).field, T_.data(), B.data());
            if (k)
                information_before_move(information.data(), n_, path.motion[k],
                                        frames.at(k, n_).decay, T_.data());
        }
    }

    // Copies a state and its covariance, both with rows of `wide` numbers.
    INLINE void copy(const double* x, const double* P, double* to_x, double* to_P) const {
        std::memcpy(to_x, x, n_.wide * sizeof(double));
        std::memcpy(to_P, P, n_.square() * sizeof(double));
    }

  private:
    // C = A B, all (n_x, wide).
    INLINE void multiply(const double* A, const double* B, double* C) const {
        for (int i = 0; i < n_.n_x; ++i)
            for (int v = 0; v < n_.n_eights; ++v) {
                Eight sum = {};
                for (int m = 0; m < n_.n_x; ++m)
                    sum += A[i * n_.wide + m] * eights(B + m * n_.wide)[v];
                eights(C + i * n_.wide)[v] = sum;
            }
    }

    INLINE const double* linearised_at(const double* path, const double* x) {
        if (!std::isnan(path[0])) return path;
        std::copy(x, x + n_.n_x, x_lin_.data());
        return x_lin_.data();
    }

    INLINE bool is_implausible(const double* y, const std::vector<double>& nis,
                               double max_nis) const {
        double total = 0.0;
        int axes = 0;
        for (int j = 0; j < n_.n_sensors; ++j) {
            if (!std::isnan(nis[j])) total += nis[j];
            for (int a = 0; a < 3; ++a) axes += !std::isnan(y[3 * j + a]);
        }
        return total > max_nis * axes;
    }

    // Computes the fields h_, their derivative `H` and inflation_ at the state `x`; returns false
    // if one of them is not finite.
    INLINE bool evaluate(const Frame& frame, const double* x, const double* near_field_length,
                         double* H) {
        double at[MAX_TARGET_STATES], total = 0.0;
        std::copy(x, x + n_.n_t, at);
        for (int j = 0; j < n_.n_sensors; ++j, H += 3 * n_.n_seen()) {
            const double* position = sensors_.positions + 3 * j;
            double R[9], world[3], error;
            mounting_rotation(j, x + n_.own(j), R);
            if (frame.offset[j] == 0.0) {
                error = field_and_error(target_, at, position, R, near_field_length, world, H,
                                        n_.n_seen());
            } else {
                Motion motion;
                target_.move(x, frame.offset[j], motion);
                for (int r = 0; r < motion.n; ++r) at[motion.rows[r]] = motion.moved[r];
                error = field_and_error(target_, at, position, R, near_field_length, world, H,
                                        n_.n_seen());
                to_prior_state(motion, H);
                for (int r = 0; r < motion.n; ++r) at[motion.rows[r]] = x[motion.rows[r]];
            }
            evaluate_own(j, x + n_.own(j), R, world, error, H);
            // Near a dipole the derivative diverges only together with the error.
            total += error + h_[3 * j] + h_[3 * j + 1] + h_[3 * j + 2];
        }
        return std::isfinite(total);
    }

    // Rotation `R` = (I + [a]x) R_sw of sensor j, with the mounting angles a.
    INLINE void mounting_rotation(int j, const double* angles, double* R) const {
        const double* R_sw = sensors_.R_sw + 9 * j;
        std::copy(R_sw, R_sw + 9, R);
        if (!sensors_.n_angles) return;
        for (int a = 0; a < 3; ++a) {
            const int b = (a + 1) % 3, c = (a + 2) % 3;
            for (int i = 0; i < 3; ++i)
                R[3 * a + i] += angles[b] * R_sw[3 * c + i] - angles[c] * R_sw[3 * b + i];
        }
    }

    // Converts `H` (3, n_seen) from the moved state to the state before the motion: H F.
    INLINE void to_prior_state(const Motion& motion, double* H) const {
        for (int a = 0; a < 3; ++a, H += n_.n_seen()) {
            double by_moved[MAX_ROWS];
            for (int r = 0; r < motion.n; ++r) {
                by_moved[r] = H[motion.rows[r]];
                H[motion.rows[r]] = 0.0;
            }
            for (int r = 0; r < motion.n; ++r)
                for (int m = 0; m < motion.width; ++m)
                    H[motion.columns[r][m]] += by_moved[r] * motion.f[r][m];
        }
    }

    // Field and inflation of sensor j, and the columns of its `H` for its own states.
    INLINE void evaluate_own(int j, const double* own, const double* R, const double* world,
                             double error, double* H) {
        double plain[3], *h = &h_[3 * j];
        for (int a = 0; a < 3; ++a) {
            plain[a] = h[a] = 0.0;
            for (int b = 0; b < 3; ++b) {
                plain[a] += sensors_.R_sw[9 * j + 3 * a + b] * world[b];
                h[a] += R[3 * a + b] * world[b];
            }
        }
        double* column = H + n_.n_t;
        if (sensors_.n_angles) {
            for (int a = 0; a < 3; ++a) {
                // a x h = -[h]x a
                const int b = (a + 1) % 3, c = (a + 2) % 3;
                column[a * n_.n_seen() + a] = 0.0;
                column[b * n_.n_seen() + c] = plain[a];
                column[c * n_.n_seen() + b] = -plain[a];
            }
            column += 3;
        }
        const double square = plain[0] * plain[0] + plain[1] * plain[1] + plain[2] * plain[2];
        inflation_[j] = error * error + sensors_.field_error * sensors_.field_error * square;
        if (!sensors_.n_errors) return;
        const double size = std::sqrt(inflation_[j]);
        inflation_[j] = 0.0;
        for (int a = 0; a < 3; ++a) {
            h[a] += size * own[sensors_.n_angles + a];
            for (int b = 0; b < 3; ++b) column[a * n_.n_seen() + b] = a == b ? size : 0.0;
        }
    }

    Target target_;
    Sensors sensors_;
    Sizes n_;
    Numbers Q_, T_, h_, inflation_, x_lin_;
};

}  // namespace mag_tracking
