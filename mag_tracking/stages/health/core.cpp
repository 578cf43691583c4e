// Python module of the buffer of raw readings; see window.py.

#include "../../python.hpp"

namespace mag_tracking {
namespace {

Size add_readings(Integers rows, Integers stamps, Array fields, std::int64_t received_ns,
                  Size first, Integers count, Integers stamp, Integers received, Array field) {
    const Size n = length_of(rows, "rows", 1), n_sensors = length_of(stamp, "stamp", 2);
    const Size capacity = stamp.shape(1);
    const std::int64_t *row = input_of(rows, "rows", {n}), *time = input_of(stamps, "stamps", {n});
    const double* value = input_of(fields, "fields", {n, 3});
    std::int64_t* counts = data_of(count, "count", {n_sensors});
    std::int64_t* times = data_of(stamp, "stamp", {n_sensors, capacity});
    std::int64_t* came = data_of(received, "received", {n_sensors, capacity});
    double* values = data_of(field, "field", {n_sensors, capacity, 3});
    if (first < 0) throw py::index_error("first: negative");
    for (Size i = first; i < n; ++i) {
        const std::int64_t j = row[i];
        if (j < 0) continue;
        if (j >= n_sensors) throw py::index_error("rows: sensor index out of range");
        if (counts[j] < 0 || counts[j] > capacity)
            throw py::index_error("count: outside the capacity of the buffer");
        if (counts[j] == capacity) return i;
        const Size k = j * capacity + counts[j]++;
        times[k] = time[i], came[k] = received_ns;
        for (int a = 0; a < 3; ++a) values[3 * k + a] = value[3 * i + a];
    }
    return n;
}

}  // namespace
}  // namespace mag_tracking

PYBIND11_MODULE(core, m) {
    using namespace mag_tracking;
    m.doc() = "Compiled buffer of raw readings.";
    m.def("add_readings", &add_readings, IN(rows), IN(stamps), IN(fields), py::arg("received_ns"),
          py::arg("first"), IN(count), IN(stamp), IN(received), IN(field));
}
