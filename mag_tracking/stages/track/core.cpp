// Python module with the compiled part of the tracker, for bank_filter.py and pass_samples.py.

#include <array>
#include <string>

#include "../../python.hpp"
#include "bank.hpp"
#include "steady_fit.hpp"

namespace mag_tracking {
namespace {

// Number of targets that share the state of a filter.
template <class Target>
Size number_of(const Target&) {
    return 1;
}
Size number_of(const Vehicles& vehicles) { return vehicles.count; }

template <class Target>
class CompiledFilter {
  public:
    CompiledFilter(const Target& target, Array positions, Array R_sw, int n_angles, int n_errors)
        : target_(target), n_sensors_(int(length_of(positions, "positions", 2))),
          n_angles_(n_angles), n_errors_(n_errors) {
        const auto n = length_of(positions, "positions", 2);
        const double* p = data_of(positions, "positions", {n, 3});
        const double* r = data_of(R_sw, "R_sw", {n, 3, 3});
        positions_.assign(p, p + 3 * n);
        R_sw_.assign(r, r + 9 * n);
        if ((n_angles != 0 && n_angles != 3) || (n_errors != 0 && n_errors != 3))
            throw py::value_error("n_angles and n_errors: expected zero or three states");
        if (target.n() > MAX_TARGET_STATES)
            throw py::value_error(
                "n_states: more states than the maximum of " + std::to_string(MAX_TARGET_STATES));
    }

    void advance(Array field, Array covariance, Array offset, double dt, Array decay,
                 Array variance, bool moves, int iterations, double field_error,
                 Array near_field_length, Array x, Array P, Array new_x, Array new_P,
                 Array predicted, Array log_likelihood, Array nis) const {
        const Sizes n = sizes();
        const Size n_hyp = length_of(near_field_length, "near_field_length", 2);
        const Size n_targets = near_field_length.shape(1);
        const Size n_s = n_sensors_, n_x = n.n_x;
        const Frame frame{
            data_of(field, "field", {n_s, 3}),      data_of(covariance, "covariance", {n_s, 3, 3}),
            data_of(offset, "offset", {n_s}),       dt,
            data_of(decay, "decay", {n_x - n.n_t}), data_of(variance, "variance", {n_x - n.n_t})};
        const Bank bank{int(n_hyp), int(n_targets),
                        input_of(near_field_length, "near_field_length",
                                 {n_hyp, number_of(target_)}),
                        data_of(x, "x", {n_hyp, n_x}), data_of(P, "P", {n_hyp, n_x, n_x})};
        const Advanced out{data_of(new_x, "new_x", {n_hyp, n_x}),
                           data_of(new_P, "new_P", {n_hyp, n_x, n_x}),
                           data_of(predicted, "predicted", {n_hyp, n_x}),
                           data_of(log_likelihood, "log_likelihood", {n_hyp}),
                           data_of(nis, "nis", {n_hyp, n_s})};
        check_noise(frame.covariance, n_s);
        py::gil_scoped_release release;
        mag_tracking::advance(target_, sensors(field_error), n, frame, moves, iterations, bank,
                              out);
    }

    void run_along(Array field, Array covariance, Array offset, Array dt, Array decay,
                   Array variance, bool first_is_updated, double max_nis, int iterations,
                   int passes, double step, double field_error, Array near_field_length, Array x,
                   Array P, Array new_x, Array new_P, Array paths, Array log_likelihood,
                   Array max_shift, Array covariances, ArrayOf<bool> used) const {
        const Sizes n = sizes();
        const Size n_hyp = length_of(near_field_length, "near_field_length", 2);
        const Size n_targets = near_field_length.shape(1);
        const Size n_s = n_sensors_, n_x = n.n_x;
        const Size n_frames = length_of(dt, "dt", 1);
        const Frames frames{int(n_frames),
                            data_of(field, "field", {n_frames, n_s, 3}),
                            data_of(covariance, "covariance", {n_frames, n_s, 3, 3}),
                            data_of(offset, "offset", {n_frames, n_s}),
                            dt.data(),
                            data_of(decay, "decay", {n_frames, n_x - n.n_t}),
                            data_of(variance, "variance", {n_frames, n_x - n.n_t})};
        const Bank bank{int(n_hyp), int(n_targets),
                        input_of(near_field_length, "near_field_length",
                                 {n_hyp, number_of(target_)}),
                        data_of(x, "x", {n_hyp, n_x}), data_of(P, "P", {n_hyp, n_x, n_x})};
        const Advanced out{data_of(new_x, "new_x", {n_hyp, n_x}),
                           data_of(new_P, "new_P", {n_hyp, n_x, n_x}), nullptr, nullptr, nullptr};
        const bool wants_covariances = covariances.size() > 0;
        const Along along{
            first_is_updated,
            max_nis,
            iterations,
            passes,
            step,
            data_of(paths, "paths", {n_hyp, n_frames, n_x}),
            data_of(log_likelihood, "log_likelihood", {n_hyp}),
            data_of(max_shift, "max_shift", {n_hyp}),
            wants_covariances ? data_of(covariances, "covariances", {n_hyp, n_frames, n_x, n_x})
                              : nullptr,
            data_of(used, "used", {n_hyp, n_frames})};
        check_noise(frames.covariance, n_frames * n_s);
        py::gil_scoped_release release;
        mag_tracking::run_along(target_, sensors(field_error), n, frames, bank, along, out);
    }

  private:
    Sizes sizes() const { return {target_.n(), n_angles_ + n_errors_, n_sensors_}; }

    Sensors sensors(double field_error) const {
        return {n_angles_, n_errors_, positions_.data(), R_sw_.data(), field_error};
    }

    // Raises ValueError if one of n covariances C (3, 3) is not positive definite.
    static void check_noise(const double* C, Size n) {
        for (; n; --n, C += 9) {
            const double l10 = C[3] / C[0], l20 = C[6] / C[0], e1 = C[4] - l10 * C[3];
            const double e21 = C[7] - l20 * C[3];
            if (!(C[0] > 0.0 && e1 > 0.0 && C[8] - l20 * C[6] - e21 / e1 * e21 > 0.0))
                throw py::value_error("the noise covariance of a sensor is not positive definite");
        }
    }

    Target target_;
    int n_sensors_, n_angles_, n_errors_;
    std::vector<double> positions_, R_sw_;
};

// Binds the filter of one target type as the Python class `name`.
template <class Target, class... Numbers>
void add_filter(py::module_& module, const char* name, Target (*target)(Numbers...)) {
    using Class = CompiledFilter<Target>;
    py::class_<Class>(module, name)
        .def(py::init(
            [target](Array positions, Array R_sw, int n_angles, int n_errors, Numbers... numbers) {
        return Class(target(numbers...), positions, R_sw, n_angles, n_errors);
    }))
        .def("advance", &Class::advance, IN(field), IN(covariance), IN(offset), IN(dt), IN(decay),
             IN(variance), IN(moves), IN(iterations), IN(field_error), IN(near_field_length), IN(x),
             IN(P), IN(new_x), IN(new_P), IN(predicted), IN(log_likelihood), IN(nis))
        .def("run_along", &Class::run_along, IN(field), IN(covariance), IN(offset), IN(dt),
             IN(decay), IN(variance), IN(first_is_updated), IN(max_nis), IN(iterations), IN(passes),
             IN(step), IN(field_error), IN(near_field_length), IN(x), IN(P), IN(new_x), IN(new_P),
             IN(paths), IN(log_likelihood), IN(max_shift), IN(covariances), IN(used));
}

void fit_steady_pass(Array theta, Array cost, Array covariance, Integers free, Array fixed,
                     Array offsets, Array combinations, Array t, Array positions, Array M,
                     Integers clock, Array y, Array nuisance, int n_steps, double tolerance,
                     double max_damping, double full_rank, double linear_rank, double rank) {
    const Size n = length_of(theta, "theta", 2), k = length_of(free, "free", 1);
    const Size n_t = length_of(t, "t", 1), d = length_of(offsets, "offsets", 1);
    const Size n_whole = length_of(fixed, "fixed", 1),
               q = (length_of(nuisance, "nuisance", 2), nuisance.shape(1));
    const std::int64_t *clocks = input_of(clock, "clock", {n_t}), *columns = free.data();
    if (n_whole < N_PATH) throw py::value_error("fixed: fewer elements than a path");
    for (Size i = 0; i < n_t; ++i)
        if (clocks[i] < -1 || clocks[i] >= n_whole - N_PATH)
            throw py::value_error("clock: index out of range");
    for (Size i = 0; i < k; ++i)
        if (columns[i] < 0 || columns[i] >= n_whole)
            throw py::value_error("free: index out of range");
    const Samples samples{n_t, t.data(), input_of(positions, "positions", {n_t, 3}),
                          input_of(M, "M", {n_t, 3, 3})};
    SteadyModel model({int(d), offsets.data()}, input_of(combinations, "combinations", {d, d}),
                      samples, clocks, fixed.data(), int(n_whole), columns, int(k));
    const double* values = input_of(y, "y", {3 * n_t});
    const double* projected = input_of(nuisance, "nuisance", {3 * n_t, q});
    Rows rows(int(3 * n_t), int(q));
    for (Size i = 0; i < 3 * n_t; ++i)
        std::copy(projected + i * q, projected + (i + 1) * q, rows.row(int(i)));
    double *found = data_of(theta, "theta", {n, k}), *costs = data_of(cost, "cost", {n});
    double* C = data_of(covariance, "covariance", {n, k, k});
    py::gil_scoped_release release;
    fit_steady(model, values, rows, {n_steps, tolerance, max_damping, full_rank, linear_rank, rank},
               n, found, costs, C);
}

using Vector = std::array<double, 3>;

RowVehicle row_vehicle(int n_states, int n_dipoles, Vector density, Vector field_strength,
                       double moment_drift, double difference_drift, double turn_acceleration,
                       double turn_time, double max_turn_rate) {
    if (n_dipoles < 1
        || n_states != 9 + 3 * n_dipoles + (n_dipoles > 1) + (turn_acceleration != 0.0))
        throw py::value_error("n_states: does not match the number of dipoles");
    return {n_states,
            n_dipoles,
            {density[0], density[1], density[2]},
            {field_strength[0], field_strength[1], field_strength[2]},
            moment_drift,
            difference_drift,
            turn_acceleration,
            turn_time,
            max_turn_rate};
}

Vehicles vehicles(int count, int n_states, int n_dipoles, Vector density, Vector field_strength,
                  double moment_drift, double difference_drift, double turn_acceleration,
                  double turn_time, double max_turn_rate) {
    if (count < 1 || count > MAX_TARGETS)
        throw py::value_error("count: from 1 to " + std::to_string(MAX_TARGETS));
    return {row_vehicle(n_states, n_dipoles, density, field_strength, moment_drift,
                        difference_drift, turn_acceleration, turn_time, max_turn_rate),
            count};
}

Magnet magnet(Vector density, double angular_density) {
    return {{density[0], density[1], density[2]}, angular_density};
}

}  // namespace
}  // namespace mag_tracking

PYBIND11_MODULE(core, module) {
    using namespace mag_tracking;
    module.doc() =
        "Compiled filters and pass fit of the tracker; see bank_filter.py and pass_samples.py.";
    add_filter(module, "RowVehicleFilter", row_vehicle);
    add_filter(module, "VehiclesFilter", vehicles);
    add_filter(module, "MagnetFilter", magnet);
    module.attr("MAX_TARGETS") = MAX_TARGETS;
    module.def("fit_steady_pass", &fit_steady_pass, IN(theta), IN(cost), IN(covariance), IN(free),
               IN(fixed), IN(offsets), IN(combinations), IN(t), IN(positions), IN(M), IN(clock),
               IN(y), IN(nuisance), IN(n_steps), IN(tolerance), IN(max_damping), IN(full_rank),
               IN(linear_rank), IN(rank));
}
