// Python module of the sample alignment; core.pyi documents the arguments.

#include "../../python.hpp"
#include "alignment.hpp"

namespace mag_tracking {
namespace {

int hold(Alignment& alignment, bool is_checked, Integers passed, Integers rows, Integers stamps,
         Array fields, Array covariances) {
    const Size n = length_of(rows, "rows", 1);
    const Samples in{n, input_of(rows, "rows", {n}), input_of(stamps, "stamps", {n}),
                     input_of(fields, "fields", {n, 3}),
                     input_of(covariances, "covariances", {n, 3, 3})};
    if (alignment.next < 0) throw py::index_error("next: negative");
    for (Size k = alignment.next; k < n; ++k)
        if (in.rows[k] >= alignment.n_sensors())
            throw py::index_error("rows: sensor index out of range");
    return alignment.hold(is_checked, data_of(passed, "passed", {alignment.n_sensors()}), in);
}

py::object frame(Alignment& alignment, bool is_final) {
    if (!alignment.look_ahead() || (!is_final && alignment.waits())) return py::none();
    const Size n = alignment.n_sensors();
    Array field({n, Size(3)}), covariance({n, Size(3), Size(3)}), offset(n);
    Integers n_samples(n);
    std::fill_n(field.mutable_data(), 3 * n, 0.0);
    std::fill_n(covariance.mutable_data(), 9 * n, 0.0);
    std::fill_n(n_samples.mutable_data(), n, 0);
    const int64_t stamp = alignment.frame({field.mutable_data(), covariance.mutable_data(),
                                           n_samples.mutable_data(), offset.mutable_data()});
    return py::make_tuple(stamp, field, covariance, n_samples, offset);
}

void drop(Alignment& alignment, int64_t i) {
    if (i < 0 || i >= alignment.n_sensors()) throw py::index_error("i: sensor index out of range");
    alignment.drop(i);
}

void add_reasons(py::module_& m) {
#define CODE(name) m.attr(#name) = int(name)
    CODE(DONE), CODE(UNKNOWN_SENSOR), CODE(NO_FIELD), CODE(NO_COVARIANCE), CODE(DUPLICATE);
    CODE(OUT_OF_ORDER), CODE(LATE), CODE(JUMPED_BACK), CODE(CLOCK_STEP), CODE(TOO_MANY);
    CODE(COMPLETE);
#undef CODE
}

}  // namespace
}  // namespace mag_tracking

PYBIND11_MODULE(core, m) {
    using namespace mag_tracking;
    m.doc() = "Compiled alignment of individual samples.";
    add_reasons(m);
    py::class_<Alignment>(m, "Alignment")
        .def(py::init([](Size n_sensors, int64_t period, int64_t wait, int64_t limit,
                         int64_t jump_back, int64_t most, bool is_burst) {
        if (n_sensors < 0) throw py::value_error("n_sensors: negative");
        return Alignment(n_sensors, {period, wait, limit, jump_back, most, is_burst});
    }),
             py::arg("n_sensors"), py::arg("period"), py::arg("wait"), py::arg("limit"),
             py::arg("jump_back"), py::arg("most"), py::arg("is_burst"))
        .def_readwrite("next", &Alignment::next)
        .def_readonly("row", &Alignment::row)
        .def_readwrite("passed", &Alignment::passed)
        .def_readwrite("is_calm", &Alignment::is_calm)
        .def_property_readonly("n_pending", &Alignment::n_pending)
        .def("hold", &hold, py::arg("is_checked"), IN(passed), IN(rows), IN(stamps), IN(fields),
             IN(covariances))
        .def("frame", &frame, py::arg("is_final"))
        .def("drop", &drop, py::arg("i"))
        .def("waits", &Alignment::waits);
}
