// Helpers shared by all pybind11 modules: array types and shape checks.

#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

namespace mag_tracking {

namespace py = pybind11;

// Arrays are never converted: writes to a converted copy would be lost.
#define IN(name) py::arg(#name).noconvert()

template <class T>
using ArrayOf = py::array_t<T, py::array::c_style>;
using Array = ArrayOf<double>;
using Integers = ArrayOf<std::int64_t>;
using Size = py::ssize_t;

// Structured array with elements of type T. Its dtype is nearly always the object that the module
// created, so identity is checked first; comparing the fields takes ten microseconds.
template <class T>
class Structs {
  public:
    explicit Structs(py::array array) : array_(std::move(array)) {
        if (!(array_.flags() & py::array::c_style)
            || (array_.dtype().ptr() != py::dtype::of<T>().ptr()
                && !py::isinstance<ArrayOf<T>>(array_)))
            throw py::type_error("structured array: wrong dtype, or not C-contiguous");
    }
    Size size() const { return array_.ndim() == 1 ? array_.shape(0) : 0; }
    T* data() { return static_cast<T*>(array_.mutable_data()); }

    // The only element; raises ValueError if the size is not one.
    T& only() {
        if (size() != 1) throw py::value_error("structured array: must have exactly one element");
        return *data();
    }

  private:
    py::array array_;
};

template <class T>
void check_shape(const ArrayOf<T>& array, const char* name, const std::vector<Size>& shape) {
    if (std::vector<Size>(array.shape(), array.shape() + array.ndim()) != shape)
        throw py::value_error(std::string(name) + ": shape does not match the other arguments");
}

// Writable data of an array of shape `shape`; raises ValueError for another shape or a read-only
// array.
template <class T>
T* data_of(ArrayOf<T>& array, const char* name, const std::vector<Size>& shape) {
    check_shape(array, name, shape);
    return array.size() ? array.mutable_data() : nullptr;
}

// Read-only data of an array of shape `shape`; raises ValueError for another shape.
template <class T>
const T* input_of(const ArrayOf<T>& array, const char* name, const std::vector<Size>& shape) {
    check_shape(array, name, shape);
    return array.size() ? array.data() : nullptr;
}

// Length of the first axis; raises ValueError if the array does not have `dimensions` axes.
template <class T>
Size length_of(const ArrayOf<T>& array, const char* name, int dimensions) {
    if (array.ndim() != dimensions)
        throw py::value_error(
            std::string(name) + ": must have " + std::to_string(dimensions) + " dimensions");
    return array.shape(0);
}

}  // namespace mag_tracking
