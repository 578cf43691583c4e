// What modules that are compiled for Python have in common.

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

// Arrays are taken as they are: what is written into a copy would be lost.
#define IN(name) py::arg(#name).noconvert()

template <class T>
using ArrayOf = py::array_t<T, py::array::c_style>;
using Array = ArrayOf<double>;
using Integers = ArrayOf<std::int64_t>;
using Size = py::ssize_t;

// A structured array, whose elements are structs. Its type is nearly always the very object that the
// module gave out; to compare fields takes ten microseconds.
template <class T>
class Structs {
  public:
    explicit Structs(py::array array) : array_(std::move(array)) {
        if (!(array_.flags() & py::array::c_style)
            || (array_.dtype().ptr() != py::dtype::of<T>().ptr()
                && !py::isinstance<ArrayOf<T>>(array_)))
            throw py::type_error("a structured array of another type, or not contiguous");
    }
    Size size() const { return array_.ndim() == 1 ? array_.shape(0) : 0; }
    T* data() { return static_cast<T*>(array_.mutable_data()); }

    // The only element; raises ValueError where there is not one.
    T& only() {
        if (size() != 1) throw py::value_error("a structured array that has not one element");
        return *data();
    }

  private:
    py::array array_;
};

template <class T>
void check_shape(const ArrayOf<T>& array, const char* name, const std::vector<Size>& shape) {
    if (std::vector<Size>(array.shape(), array.shape() + array.ndim()) != shape)
        throw py::value_error(std::string(name) + ": not of the shape that the others ask for");
}

// The data of an array of the shape `shape`, to be changed; raises ValueError for another shape,
// and for an array that may not be written to.
template <class T>
T* data_of(ArrayOf<T>& array, const char* name, const std::vector<Size>& shape) {
    check_shape(array, name, shape);
    return array.size() ? array.mutable_data() : nullptr;
}

// As `data_of`, to be read only.
template <class T>
const T* input_of(const ArrayOf<T>& array, const char* name, const std::vector<Size>& shape) {
    check_shape(array, name, shape);
    return array.size() ? array.data() : nullptr;
}

// Its first length; raises ValueError where it has not `dimensions` of them.
template <class T>
Size length_of(const ArrayOf<T>& array, const char* name, int dimensions) {
    if (array.ndim() != dimensions)
        throw py::value_error(std::string(name) + ": has another number of dimensions");
    return array.shape(0);
}

}  // namespace mag_tracking
