// Python module of the operations on every reading; the arguments are described in core.pyi.

#include "../python.hpp"
#include "readings.hpp"

namespace mag_tracking {
namespace {

// Arrays of `Sensor`, `Limits`, `Batch`.
using Structured = py::array;

// Python may have changed the values that are used as indices.
Sensor& checked(Sensor& s) {
    if (s.now < 0 || s.now > 1 || s.n_held < 0 || s.n_held > MAX_HELD + 1 || s.n_steps < 0
        || s.n_window < 0 || s.n_marks < 0 || s.n_marks > MAX_MARKS)
        throw py::value_error(
            "now, n_held, n_steps, n_window or n_marks of a sensor is out of range");
    return s;
}

Sensor& sensor_of(Structured& sensors) { return checked(Structs<Sensor>(sensors).only()); }

Calibrated room_of(Integers& rows, Integers& stamps, Array& fields, Array& covariances) {
    const Size n = length_of(rows, "out_rows", 1);
    return {n, data_of(rows, "out_rows", {n}), data_of(stamps, "out_stamps", {n}),
            data_of(fields, "out_fields", {n, 3}),
            data_of(covariances, "out_covariances", {n, 3, 3})};
}

int calibrate_readings(Structured sensors, Structured limits, Integers rows, Integers stamps,
                       Array fields, Integers own, Array covariances, Structured batches,
                       Integers out_rows, Integers out_stamps, Array out_fields,
                       Array out_covariances) {
    const Size n = length_of(rows, "rows", 1);
    Structs<Sensor> all(sensors);
    const RawReadings in{n,
                         input_of(rows, "rows", {n}),
                         input_of(stamps, "stamps", {n}),
                         input_of(fields, "fields", {n, 3}),
                         input_of(own, "own", {n}),
                         covariances.data()};
    Batch& batch = Structs<Batch>(batches).only();
    if (batch.next < 0) throw py::index_error("next: must not be negative");
    for (Size i = batch.next; i < n; ++i) {
        if (in.rows[i] >= all.size()) throw py::index_error("rows: a sensor index is out of range");
        if (in.rows[i] >= 0) checked(all.data()[in.rows[i]]);
        if (in.own[i]) input_of(covariances, "covariances", {n, 3, 3});
    }
    return calibrate(all.data(), Structs<Limits>(limits).only(), in, batch,
                     room_of(out_rows, out_stamps, out_fields, out_covariances));
}

bool use_reading(Structured sensors, Structured limits, Structured batches, int64_t row,
                 int64_t stamp, Array field, int64_t own, Array covariance, Integers out_rows,
                 Integers out_stamps, Array out_fields, Array out_covariances) {
    Structs<Sensor> all(sensors);
    if (row < 0 || row >= all.size())
        throw py::index_error("row: the sensor index is out of range");
    const Reading reading{stamp, input_of(field, "field", {3}), own,
                          input_of(covariance, "covariance", {3, 3})};
    return use(checked(all.data()[row]), Structs<Limits>(limits).only(),
               Structs<Batch>(batches).only(), row, reading,
               room_of(out_rows, out_stamps, out_fields, out_covariances));
}

void subtract(Structured sensors, double time, Array field, Array out) {
    subtract_background(sensor_of(sensors), time, input_of(field, "field", {3}),
                        data_of(out, "out", {3}));
}

Array steps_of(Structured sensors, bool are_corrected) {
    const Sensor& s = sensor_of(sensors);
    Array out(3);
    double* steps = out.mutable_data();
    if (are_corrected)
        corrected_steps(s, steps);
    else
        for (int a = 0; a < 3; ++a) steps[a] = seen_step(s, a);
    return out;
}

py::tuple block_moments(Structured sensors) {
    const Sensor& s = sensor_of(sensors);
    Array mean(3), scatter({3, 3}), n(3);
    const int64_t k = 1 - s.now;
    moments(s, k, mean.mutable_data(), scatter.mutable_data());
    for (int a = 0; a < 3; ++a) n.mutable_data()[a] = s.count[k][a][a];
    return py::make_tuple(s.time[k] / double(s.n[k]), mean, scatter, n);
}

py::tuple line_through(Array time, Array n, Array y, double centre) {
    const Size k = length_of(time, "time", 1);
    const double *t = input_of(time, "time", {k}), *weight = input_of(n, "n", {k, 3});
    const double* values = input_of(y, "y", {k, 3});
    Array mean(3), slope(3);
    for (int a = 0; a < 3; ++a)
        line(k, t, weight + a, values + a, centre, mean.mutable_data()[a], slope.mutable_data()[a]);
    return py::make_tuple(mean, slope);
}

py::object pooled_covariance(Array scatter, Array n) {
    const Size k = length_of(scatter, "scatter", 3);
    Array out({3, 3});
    const bool is_enough = pool(k, input_of(scatter, "scatter", {k, 3, 3}),
                                input_of(n, "n", {k, 3}), out.mutable_data());
    return is_enough ? py::object(out) : py::none();
}

void add_constants(py::module_& m) {
    m.attr("N_RECENT") = N_RECENT;
    m.attr("MAX_HELD") = MAX_HELD;
    m.attr("N_WINDOW") = N_WINDOW;
    m.attr("MAX_MARKS") = MAX_MARKS;
    m.attr("COARSE_FRACTION") = COARSE_FRACTION;
    m.attr("MIN_CHANGES") = MIN_CHANGES;
    m.attr("MAX_ROUNDING") = MAX_ROUNDING;
    m.attr("DITHERED") = DITHERED;
    m.attr("MIN_STD") = MIN_STD;
    m.attr("TOGGLE_TOLERANCE") = TOGGLE_TOLERANCE;
    m.attr("MAX_REST_NS") = MAX_REST_NS;
#define CODE(name) m.attr(#name) = int(name)
    CODE(DONE), CODE(UNKNOWN_SENSOR), CODE(NO_AXIS), CODE(INFINITE), CODE(TOO_LARGE);
    CODE(BAD_COVARIANCE), CODE(AXIS_MISSING), CODE(TOO_FAR_AHEAD), CODE(DUPLICATE);
    CODE(OUT_OF_ORDER), CODE(STUCK), CODE(MARKED), CODE(REPEATED), CODE(BLOCK_COMPLETE);
    CODE(WINDOW_COMPLETE), CODE(JUMPED_BACK), CODE(RESTORABLE);
    CODE(SPIKES), CODE(PASSED), CODE(NONE), CODE(VALID), CODE(INVALID);
    CODE(PASSES), CODE(HELD), CODE(SPIKE), CODE(RELEASED);
#undef CODE
}

// Register the element types of the structured arrays.
void add_types(py::module_& m) {
    PYBIND11_NUMPY_DTYPE(
        Sensor, clock_offset_ns, offset, has_correction, correction, is_ready, centre, mean, slope,
        horizon, noise, noise_std, level_variance, first_ns, last_ns, unconfirmed_ns, is_restorable,
        accepted, window, window_ns, n_window, window_due, n_marks, marks, n_marked, repetition,
        latest, last, run, repeats, changes, raw, rest_since_ns, n_rest, n_same, n_changed, step,
        step_variance, n_averaged, stated_std, n_overruled, before_ns, before, n_steps, steps,
        n_held, n_released, held_ns, held_field, held_steps, held_own, held_covariance, length,
        phase, end, now, is_full, n, time, origin, count, sum, product);
    PYBIND11_NUMPY_DTYPE(Limits, max_field, longest_jump_ns, jump_back_ns, reject_stuck, spike_std,
                         is_decimated, trust_covariances);
    PYBIND11_NUMPY_DTYPE(Batch, next, row, n_out, n_spikes, n_learning, n_partly_learning,
                         n_overruled, stamp_ns);
    m.attr("SENSOR") = py::dtype::of<Sensor>();
    m.attr("LIMITS") = py::dtype::of<Limits>();
    m.attr("BATCH") = py::dtype::of<Batch>();
}

}  // namespace
}  // namespace mag_tracking

PYBIND11_MODULE(core, m) {
    using namespace mag_tracking;
    m.doc() = "Calibration of readings one by one, compiled.";
    add_constants(m);
    add_types(m);
    m.def("calibrate_readings", &calibrate_readings, IN(sensors), IN(limits), IN(rows), IN(stamps),
          IN(fields), IN(own), IN(covariances), IN(batches), IN(out_rows), IN(out_stamps),
          IN(out_fields), IN(out_covariances));
    m.def("use_reading", &use_reading, IN(sensors), IN(limits), IN(batches), py::arg("row"),
          py::arg("stamp"), IN(field), py::arg("own"), IN(covariance), IN(out_rows), IN(out_stamps),
          IN(out_fields), IN(out_covariances));
    m.def("subtract", &subtract, IN(sensors), py::arg("time"), IN(field), IN(out));
    m.def("steps_of", &steps_of, IN(sensors), py::arg("are_corrected"));
    m.def("block_moments", &block_moments, IN(sensors));
    m.def("line_through", &line_through, IN(time), IN(n), IN(y), py::arg("centre"));
    m.def("pooled_covariance", &pooled_covariance, IN(scatter), IN(n));
    m.def("complete_steps", [](Array variance, Array steps) {
        complete_steps(input_of(variance, "variance", {3}), data_of(steps, "steps", {3}));
    }, IN(variance), IN(steps));
    m.def("apply_steps", [](Structured sensors, double freeze_std, Array limits) {
        apply_steps(sensor_of(sensors), freeze_std, data_of(limits, "limits", {3}));
    }, IN(sensors), py::arg("freeze_std"), IN(limits));
    // For one sensor and reading; used by tests.
    m.def("note_step", [](Structured sensors, int64_t stamp, Array raw) {
        note_step(sensor_of(sensors), stamp, input_of(raw, "raw", {3}));
    }, IN(sensors), py::arg("stamp"), IN(raw));
    m.def("is_stuck", [](Structured sensors, Array field) {
        return is_stuck(sensor_of(sensors), input_of(field, "field", {3}));
    }, IN(sensors), IN(field));
    m.def("screen_spike", [](Structured sensors, double threshold, int64_t stamp, Array field) {
        return int(screen_spike(sensor_of(sensors), threshold,
                                {stamp, input_of(field, "field", {3}), NONE, nullptr}));
    }, IN(sensors), py::arg("threshold"), py::arg("stamp"), IN(field));
    m.def("collect", [](Structured sensors, double time, Array field) {
        begin_block_if_due(sensor_of(sensors), time);
        collect(sensor_of(sensors), time, input_of(field, "field", {3}));
    }, IN(sensors), py::arg("time"), IN(field));
}
