// Python module of the per-frame computations for resting axes; see stage.py.

#include <algorithm>
#include <cmath>

#include "../../python.hpp"

namespace mag_tracking {
namespace {

void learn(Array field, double memory, Array n, Array square) {
    const Size n_sensors = length_of(field, "field", 2);
    const double* y = input_of(field, "field", {n_sensors, 3});
    double *count = data_of(n, "n", {n_sensors, 3}),
           *mean = data_of(square, "square", {n_sensors, 3});
    for (Size i = 0; i < 3 * n_sensors; ++i) {
        if (std::isnan(y[i])) continue;
        count[i] = std::min(count[i] + 1.0, memory);
        mean[i] += (y[i] * y[i] - mean[i]) / count[i];
    }
}

Array scaled(Array covariance, Array n, Array square, double least, double factor, double most,
             double allowance) {
    const Size n_sensors = length_of(covariance, "covariance", 3);
    const double* C = input_of(covariance, "covariance", {n_sensors, 3, 3});
    const double* count = input_of(n, "n", {n_sensors, 3});
    const double* mean = input_of(square, "square", {n_sensors, 3});
    Array out({n_sensors, Size(3), Size(3)});
    double* scaled = out.mutable_data();
    for (Size j = 0; j < n_sensors; ++j, C += 9, scaled += 9, count += 3, mean += 3) {
        double std[3];
        for (int a = 0; a < 3; ++a)
            // A comparison with NaN is false: a missing axis is not at rest.
            std[a] = count[a] >= least && factor * mean[a] < C[4 * a] ? std::sqrt(1.0 / most) : 1.0;
        for (int a = 0; a < 3; ++a) {
            for (int b = 0; b < 3; ++b) scaled[3 * a + b] = C[3 * a + b] * std[a] * std[b];
            scaled[4 * a] += allowance;
        }
    }
    return out;
}

}  // namespace
}  // namespace mag_tracking

PYBIND11_MODULE(core, m) {
    using namespace mag_tracking;
    m.doc() = "Compiled functions for axes with coarse resolution.";
    m.def("learn", &learn, IN(field), py::arg("memory"), IN(n), IN(square));
    m.def("scaled", &scaled, IN(covariance), IN(n), IN(square), py::arg("least"), py::arg("factor"),
          py::arg("most"), py::arg("allowance"));
}
