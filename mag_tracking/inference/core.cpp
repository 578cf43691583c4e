// Python module of the functions of inference that run for every frame.

#include "../python.hpp"
#include "axes.hpp"
#include "densest.hpp"
#include "gauss_markov.hpp"
#include "matrices.hpp"

namespace mag_tracking {
namespace {

bool energies(Array y, Array C, Array energy, Integers axes) {
    const Size n = length_of(y, "y", 2);
    const double *values = input_of(y, "y", {n, 3}), *covariances = input_of(C, "C", {n, 3, 3});
    double* out = data_of(energy, "energy", {n});
    std::int64_t* n_axes = data_of(axes, "axes", {n});
    for (Size j = 0; j < n; ++j)
        if (!whitened_energy(values + 3 * j, covariances + 9 * j, out[j], n_axes[j])) return false;
    return true;
}

void smallest_pivots(Array y, Array C, Array out) {
    const Size n = length_of(y, "y", 2);
    const double *values = input_of(y, "y", {n, 3}), *covariances = input_of(C, "C", {n, 3, 3});
    double* pivots = data_of(out, "out", {n});
    for (Size j = 0; j < n; ++j) pivots[j] = smallest_pivot(values + 3 * j, covariances + 9 * j);
}

double step_vectors(Array x, Array P, Array log_w, Array densities, Integers vector, Array H,
                    Array y, Array variance, double dt, double switch_s) {
    const Size n = length_of(log_w, "log_w", 2), n_strengths = log_w.shape(1);
    const Size n_y = length_of(y, "y", 1),
               m = length_of(densities, "densities", 2) ? densities.shape(1) : 0;
    length_of(x, "x", 3);
    const Size n_x = x.shape(2);
    if (n_x < m || n_x > 2 * m)
        throw py::value_error("x: must contain all levels and at most as many rates as levels");
    const VectorBank bank{int(n),
                          int(n_strengths),
                          int(m),
                          int(n_x - m),
                          data_of(x, "x", {n, n_strengths, n_x}),
                          data_of(P, "P", {n, n_strengths, n_x, n_x}),
                          log_w.mutable_data(),
                          input_of(densities, "densities", {n_strengths, m})};
    return step(bank,
                {int(n_y), input_of(vector, "vector", {n_y}), input_of(H, "H", {n_y, m}), y.data(),
                 input_of(variance, "variance", {n_y})},
                dt, switch_s);
}

bool inverses(Array A, double least, Array out) {
    const Size n = length_of(A, "A", 3), k = A.shape(1);
    const double* matrices = input_of(A, "A", {n, k, k});
    double* found = data_of(out, "out", {n, k, k});
    Inverter inverter(k);
    for (Size i = 0; i < n; ++i)
        if (!inverter.invert(matrices + i * k * k, least, found + i * k * k)) return false;
    return true;
}

Size best(Array x, Array P, Array log_w, Integers label, Integers kind, double negligible) {
    const Size n = length_of(log_w, "log_w", 1), n_x = length_of(x, "x", 2) ? x.shape(1) : 0;
    if (n < 1 || n_x < 3)
        throw py::value_error("x: must contain at least one hypothesis with a position");
    return best_of({std::size_t(n), std::size_t(n_x), input_of(x, "x", {n, n_x}),
                    input_of(P, "P", {n, n_x, n_x}), input_of(log_w, "log_w", {n}),
                    input_of(label, "label", {n}), input_of(kind, "kind", {n})},
                   negligible);
}

}  // namespace
}  // namespace mag_tracking

PYBIND11_MODULE(core, m) {
    using namespace mag_tracking;
    m.doc() = "Compiled functions of inference that run for every frame.";
    m.def("energies", &energies, IN(y), IN(C), IN(energy), IN(axes));
    m.def("smallest_pivots", &smallest_pivots, IN(y), IN(C), IN(out));
    m.def("step_vectors", &step_vectors, IN(x), IN(P), IN(log_w), IN(densities), IN(vector), IN(H),
          IN(y), IN(variance), py::arg("dt"), py::arg("switch_s"));
    m.def("inverses", &inverses, IN(A), IN(least), IN(out));
    m.def("best", &best, IN(x), IN(P), IN(log_w), IN(label), IN(kind), IN(negligible));
}
