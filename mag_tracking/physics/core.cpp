// Python module of the compiled physics, for the Python modules in this folder.

#include <algorithm>

#include "../python.hpp"
#include "anderson.hpp"
#include "dipole.hpp"
#include "motion.hpp"
#include "mounting.hpp"
#include "passes.hpp"
#include "sensor_fields.hpp"
#include "steady_pass.hpp"
#include "vehicles.hpp"

namespace mag_tracking {
namespace {

using Shape = std::vector<Size>;

// Shape (..., 3) of an array; raises ValueError for another length of the last axis.
Shape rows_of(const Array& array, const char* name) {
    if (array.ndim() < 1 || array.shape(array.ndim() - 1) != 3)
        throw py::value_error(std::string(name) + ": needs a last axis of length 3");
    return {array.shape(), array.shape() + array.ndim()};
}

// Array of a shape whose elements `set` writes without the interpreter lock.
template <class Set>
Array filled(const Shape& shape, Set set) {
    Array array(shape);
    double* out = array.mutable_data();
    {
        py::gil_scoped_release release;
        set(out);
    }
    return array;
}

Shape with(Shape shape, Size last) {
    shape.push_back(last);
    return shape;
}

Array dipole_field(const Array& d, const Array& m) {
    const Shape shape = rows_of(d, "d");
    const double *d_ = input_of(d, "d", shape), *m_ = input_of(m, "m", shape);
    const Size n = d.size();
    return filled(shape, [&](double* B) {
        for (Size i = 0; i < n; i += 3) {
            for (int a = 0; a < 3; ++a) B[i + a] = 0.0;
            Dipole({d_[i], d_[i + 1], d_[i + 2]}, {m_[i], m_[i + 1], m_[i + 2]}).add_field(B + i);
        }
    });
}

py::tuple dipole_jacobians(const Array& d, const Array& m) {
    const Shape shape = rows_of(d, "d");
    const double *d_ = input_of(d, "d", shape), *m_ = input_of(m, "m", shape);
    Array dB_dd(with(shape, 3)), dB_dm(with(shape, 3));
    double *by_place = dB_dd.mutable_data(), *by_moment = dB_dm.mutable_data();
    const Size n = d.size();
    {
        py::gil_scoped_release release;
        for (Size i = 0; i < n; i += 3)
            Dipole({d_[i], d_[i + 1], d_[i + 2]}, {m_[i], m_[i + 1], m_[i + 2]})
                .jacobians(by_place + 3 * i, by_moment + 3 * i);
    }
    return py::make_tuple(dB_dd, dB_dm);
}

py::tuple sensor_fields(const Array& positions, const Array& R_sw, const Array& r, const Array& m,
                        const Array& dr_dx, const Array& dm_dx) {
    const Size n_sensors = length_of(positions, "positions", 2), n_hyp = length_of(r, "r", 3);
    length_of(dr_dx, "dr_dx", 4);
    const Size d = r.shape(1), n_t = dr_dx.shape(3);
    const double* positions_ = input_of(positions, "positions", {n_sensors, 3});
    const double* R_ = input_of(R_sw, "R_sw", {n_sensors, 3, 3});
    const double *r_ = input_of(r, "r", {n_hyp, d, 3}), *m_ = input_of(m, "m", {n_hyp, d, 3});
    const double* dr_ = input_of(dr_dx, "dr_dx", {n_hyp, d, 3, n_t});
    const double* dm_ = input_of(dm_dx, "dm_dx", {n_hyp, d, 3, n_t});
    Array h({n_hyp, n_sensors, Size(3)}), H({n_hyp, n_sensors, Size(3), n_t});
    Array gradient({n_hyp, n_sensors});
    double *h_ = h.mutable_data(), *H_ = H.mutable_data(), *size = gradient.mutable_data();
    {
        py::gil_scoped_release release;
        set_sensor_fields({std::size_t(d), std::size_t(n_t), r_, m_, dr_, dm_}, std::size_t(n_hyp),
                          positions_, R_, std::size_t(n_sensors), h_, H_, size);
    }
    return py::make_tuple(h, H, gradient);
}

py::tuple mounted_fields(const Array& h, const Array& H, const Array& angles) {
    length_of(H, "H", 4);
    const Size n_hyp = H.shape(0), n_sensors = H.shape(1), n_t = H.shape(3);
    const double* h_ = input_of(h, "h", {n_hyp, n_sensors, 3});
    const double* H_ = input_of(H, "H", {n_hyp, n_sensors, 3, n_t});
    const double* angles_ = input_of(angles, "angles", {n_hyp, n_sensors, 3});
    Array out_h({n_hyp, n_sensors, Size(3)}), out_H({n_hyp, n_sensors, Size(3), n_t + 3});
    double *to_h = out_h.mutable_data(), *to_H = out_H.mutable_data();
    {
        py::gil_scoped_release release;
        rotated_fields(h_, H_, angles_, std::size_t(n_hyp * n_sensors), std::size_t(n_t), to_h,
                       to_H);
    }
    return py::make_tuple(out_h, out_H);
}

py::tuple propagate_turn(const Array& x, double dt, double mean_factor, double final_factor) {
    const Size n = length_of(x, "x", 2), n_x = x.shape(1);
    if (n_x < 7) throw py::value_error("x: must hold position, velocity and turn rate");
    const double* from = input_of(x, "x", {n, n_x});
    Array moved({n, n_x}), F({n, n_x, n_x});
    double *to = moved.mutable_data(), *F_ = F.mutable_data();
    std::copy(from, from + n * n_x, to);
    std::fill(F_, F_ + F.size(), 0.0);
    for (Size p = 0; p < n; ++p, from += n_x, to += n_x, F_ += n_x * n_x) {
        Motion motion;
        turn(from, int(n_x - 1), dt, mean_factor, final_factor, motion);
        for (Size i = 0; i < n_x; ++i) F_[i * n_x + i] = 1.0;
        for (int i = 0; i < motion.n; ++i) {
            const int row = motion.rows[i];
            to[row] = motion.moved[i];
            F_[row * n_x + row] = 0.0;
            for (int k = 0; k < motion.width; ++k)
                F_[row * n_x + motion.columns[i][k]] += motion.f[i][k];
        }
    }
    return py::make_tuple(moved, F);
}

py::tuple row_dipoles(const Array& x, int n_dipoles, const Array& field_strength) {
    const Size n = length_of(x, "x", 2), n_x = x.shape(1), d = n_dipoles;
    if (d < 1 || n_x < 9 + 3 * d + (d > 1))
        throw py::value_error("x: too few states for " + std::to_string(d) + " dipoles");
    const double* x_ = input_of(x, "x", {n, n_x});
    const double* h = input_of(field_strength, "field_strength", {3});
    RowVehicle vehicle{};
    vehicle.n_states = int(n_x), vehicle.n_dipoles = n_dipoles;
    std::copy(h, h + 3, vehicle.field_strength);
    Array r({n, d, Size(3)}), m({n, d, Size(3)});
    Array dr_dx({n, d, Size(3), n_x}), dm_dx({n, d, Size(3), n_x});
    double *r_ = r.mutable_data(), *m_ = m.mutable_data();
    double *dr = dr_dx.mutable_data(), *dm = dm_dx.mutable_data();
    std::fill(dr, dr + dr_dx.size(), 0.0);
    std::fill(dm, dm + dm_dx.size(), 0.0);
    for (Size p = 0; p < n; ++p)
        vehicle.dipoles(x_ + p * n_x, r_ + 3 * d * p, m_ + 3 * d * p, dr + 3 * d * n_x * p,
                        dm + 3 * d * n_x * p);
    return py::make_tuple(r, m, dr_dx, dm_dx);
}

Samples samples_of(const Array& t, const Array& positions, const Array& M) {
    const Size n = length_of(t, "t", 1);
    return {n, input_of(t, "t", {n}), input_of(positions, "positions", {n, 3}),
            input_of(M, "M", {n, 3, 3})};
}

Row row_of(const Array& offsets) {
    const Size d = length_of(offsets, "offsets", 1);
    return {int(d), input_of(offsets, "offsets", {d})};
}

Array row_bases(const Array& theta, const Array& offsets, const Array& t, const Array& positions,
                const Array& M) {
    const Samples samples = samples_of(t, positions, M);
    const Row row = row_of(offsets);
    const Size n = length_of(theta, "theta", 2), n_theta = row.n > 1 ? 7 : 6;
    const double* theta_ = input_of(theta, "theta", {n, n_theta});
    return filled({n, 3 * samples.n, Size(3 * row.n)},
                  [&](double* A) { set_row_bases(theta_, n, int(n_theta), row, samples, A); });
}

Array row_derivatives(const Array& theta, const Array& moments, const Array& offsets,
                      const Array& t, const Array& positions, const Array& M) {
    const Samples samples = samples_of(t, positions, M);
    const Row row = row_of(offsets);
    const Size n = length_of(theta, "theta", 2), n_theta = row.n > 1 ? 7 : 6;
    const double* theta_ = input_of(theta, "theta", {n, n_theta});
    const double* m = input_of(moments, "moments", {n, 3 * row.n});
    return filled({n, 3 * samples.n, n_theta}, [&](double* D) {
        set_row_derivatives(theta_, m, n, int(n_theta), row, samples, D);
    });
}

// Clock of each of `n` samples; raises ValueError for a clock that is not in `theta`.
const std::int64_t* clocks_of(const Integers& clock, Size n, const Array& theta) {
    length_of(theta, "theta", 2);
    const Size n_clocks = theta.shape(1) - N_PATH;
    if (n_clocks < 0) throw py::value_error("theta: must hold path and clock offsets");
    const std::int64_t* clocks = input_of(clock, "clock", {n});
    for (Size s = 0; s < n; ++s)
        if (clocks[s] >= n_clocks) throw py::value_error("clock: index beyond the clocks in theta");
    return clocks;
}

Array steady_bases(const Array& theta, const Array& offsets, const Array& t, const Array& positions,
                   const Array& M, const Integers& clock) {
    const Samples samples = samples_of(t, positions, M);
    const Row row = row_of(offsets);
    const std::int64_t* clocks = clocks_of(clock, samples.n, theta);
    const Size n = theta.shape(0), n_theta = theta.shape(1);
    const double* theta_ = input_of(theta, "theta", {n, n_theta});
    return filled({n, 3 * samples.n, Size(3 * row.n)}, [&](double* A) {
        set_steady_bases(theta_, n, int(n_theta), row, samples, clocks, A);
    });
}

Array steady_derivatives(const Array& theta, const Array& moments, const Array& offsets,
                         const Array& t, const Array& positions, const Array& M,
                         const Integers& clock) {
    const Samples samples = samples_of(t, positions, M);
    const Row row = row_of(offsets);
    const std::int64_t* clocks = clocks_of(clock, samples.n, theta);
    const Size n = theta.shape(0), n_theta = theta.shape(1);
    const double* theta_ = input_of(theta, "theta", {n, n_theta});
    const double* m = input_of(moments, "moments", {n, 3 * row.n});
    return filled({n, 3 * samples.n, n_theta}, [&](double* D) {
        set_steady_derivatives(theta_, m, n, int(n_theta), row, samples, clocks, D);
    });
}

double residual(const Array& t, const Array& y, double time, double scale) {
    const Size n = length_of(t, "t", 1);
    length_of(y, "y", 2);
    const Size k = y.shape(1);
    const double *t_ = input_of(t, "t", {n}), *y_ = input_of(y, "y", {n, k});
    return anderson_residual(t_, y_, std::size_t(n), std::size_t(k), time, scale);
}

}  // namespace
}  // namespace mag_tracking

PYBIND11_MODULE(core, module) {
    using namespace mag_tracking;
    module.doc() = "Compiled physics, used by the modules of this package.";
    module.attr("K_DIPOLE") = K_DIPOLE;
    module.attr("PATH") = py::tuple(py::cast(std::vector<std::string>(PATH, PATH + N_PATH)));
    module.def("dipole_field", &dipole_field, IN(d), IN(m));
    module.def("dipole_jacobians", &dipole_jacobians, IN(d), IN(m));
    module.def("sensor_fields", &sensor_fields, IN(positions), IN(R_sw), IN(r), IN(m), IN(dr_dx),
               IN(dm_dx));
    module.def("rotated_fields", &mounted_fields, IN(h), IN(H), IN(angles));
    module.def("propagate_turn", &propagate_turn, IN(x), py::arg("dt"), py::arg("mean_factor"),
               py::arg("final_factor"));
    module.def("row_dipoles", &row_dipoles, IN(x), IN(n_dipoles), IN(field_strength));
    module.def("row_bases", &row_bases, IN(theta), IN(offsets), IN(t), IN(positions), IN(M));
    module.def("row_derivatives", &row_derivatives, IN(theta), IN(moments), IN(offsets), IN(t),
               IN(positions), IN(M));
    module.def("steady_bases", &steady_bases, IN(theta), IN(offsets), IN(t), IN(positions), IN(M),
               IN(clock));
    module.def("steady_derivatives", &steady_derivatives, IN(theta), IN(moments), IN(offsets),
               IN(t), IN(positions), IN(M), IN(clock));
    module.def("anderson_residual", &residual, IN(t), IN(y), py::arg("time"), py::arg("scale"));
}
