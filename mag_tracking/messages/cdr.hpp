// Encoding of ROS messages as CDR bytes, from nested Python dicts.
//
// Reference: OMG DDS-XTypes 1.3, section 7.4.1 (XCDR version 1), little endian.

#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "../python.hpp"

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "numbers are copied byte by byte");

namespace mag_tracking {

// Output buffer. Each number is aligned to its size, counted from the end of the header.
class Bytes {
  public:
    Bytes() : data_("\0\1\0\0", HEADER) {}

    template <class T>
    void add(T value) {
        data_.append((sizeof(T) - (data_.size() - HEADER) % sizeof(T)) % sizeof(T), '\0');
        data_.append(reinterpret_cast<const char*>(&value), sizeof(T));
    }

    void add(const std::string& text) {
        add_length(text.size() + 1);
        data_.append(text.c_str(), text.size() + 1);
    }

    void add_length(std::size_t n) {
        if (n > std::numeric_limits<std::uint32_t>::max())
            throw py::value_error("more elements than CDR can encode");
        add(std::uint32_t(n));
    }

    py::bytes done() const { return py::bytes(data_); }

  private:
    static constexpr std::size_t HEADER = 4;
    std::string data_;
};

// Encoder of a number, a string or a nested message.
class Value {
  public:
    virtual ~Value() = default;
    // `value` is anything that Python's float(), int(), bool() or str() accepts; None selects the
    // default.
    virtual void add(const py::handle& value, Bytes& out) const = 0;
};

// Throws the pending Python exception, if there is one.
inline void check_python() {
    if (PyErr_Occurred()) throw py::error_already_set();
}

// Encoder of a value of a built-in type, which `Type::convert` makes of a Python object.
template <class Type>
class Scalar : public Value {
  public:
    explicit Scalar(const py::handle& default_value) : default_(Type::convert(default_value)) {}
    void add(const py::handle& value, Bytes& out) const override {
        out.add(value.is_none() ? default_ : Type::convert(value));
    }

  private:
    decltype(Type::convert(py::handle())) default_;
};

template <class T>
struct Float {
    static T convert(const py::handle& value) {
        if (PyFloat_CheckExact(value.ptr())) return narrow(PyFloat_AS_DOUBLE(value.ptr()));
        // Like float(), which also accepts strings.
        const auto converted = py::reinterpret_steal<py::object>(PyNumber_Float(value.ptr()));
        check_python();
        return narrow(PyFloat_AS_DOUBLE(converted.ptr()));
    }
    static T narrow(double value) {
        if (std::isfinite(value) && std::abs(value) > double(std::numeric_limits<T>::max()))
            throw std::overflow_error("beyond the range of its type: " + std::to_string(value));
        return T(value);
    }
};

template <class T>
struct Integer {
    static T convert(const py::handle& value) {
        const auto integer = py::reinterpret_steal<py::object>(
            PyLong_CheckExact(value.ptr()) ? value.inc_ref().ptr() : PyNumber_Long(value.ptr()));
        check_python();
        // Raises OverflowError if the value exceeds 64 bits.
        const auto wide = to_64_bits(integer.ptr(), std::is_signed<T>());
        check_python();
        if (wide < std::numeric_limits<T>::min() || wide > std::numeric_limits<T>::max())
            throw py::value_error("beyond the range of its type: " + std::to_string(wide));
        return T(wide);
    }
    static std::int64_t to_64_bits(PyObject* integer, std::true_type) {
        return PyLong_AsLongLong(integer);
    }
    static std::uint64_t to_64_bits(PyObject* integer, std::false_type) {
        return PyLong_AsUnsignedLongLong(integer);
    }
};

struct Boolean {
    static bool convert(const py::handle& value) {
        const int truth = PyObject_IsTrue(value.ptr());
        check_python();
        return truth != 0;
    }
};

struct String {
    static std::string convert(const py::handle& value) { return py::str(value); }
};

// Field of a message.
struct Field {
    py::str name;
    std::shared_ptr<const Value> value;
    Size length;  // Length of a fixed-size array, SEQUENCE (length is encoded) or ONE (no array).

    static constexpr Size SEQUENCE = -1, ONE = -2;

    void add(const py::handle& content, Bytes& out) const {
        if (length == ONE) return value->add(content, out);
        // Strings and dicts would also pass as sequences.
        if (PyUnicode_Check(content.ptr()) || PyDict_Check(content.ptr()))
            throw py::type_error(std::string(name) + ": expected a list");
        const auto items = py::reinterpret_steal<py::object>(
            content.is_none() ? PyTuple_New(0) : PySequence_Fast(content.ptr(), "expected a list"));
        check_python();
        const Size n = PySequence_Fast_GET_SIZE(items.ptr());
        if (length == SEQUENCE)
            out.add_length(n);
        else if (n && n != length)
            throw py::value_error(
                "expected " + std::to_string(length) + " elements, got " + std::to_string(n));
        for (Size i = 0; i < (length == SEQUENCE ? n : length); ++i)
            value->add(n ? py::handle(PySequence_Fast_GET_ITEM(items.ptr(), i)) : Py_None, out);
    }
};

// Message, a dict of its fields. Missing fields get their defaults.
class Message : public Value {
  public:
    explicit Message(std::vector<Field> fields) : fields_(std::move(fields)) {}

    void add(const py::handle& value, Bytes& out) const override {
        if (!value.is_none() && !PyDict_Check(value.ptr()))
            throw py::type_error("expected a message as a dict");
        // A message without fields is one byte, because IDL has no empty structures.
        if (fields_.empty()) out.add(std::uint8_t(0));
        for (const Field& field : fields_) {
            PyObject* content =
                value.is_none() ? nullptr : PyDict_GetItemWithError(value.ptr(), field.name.ptr());
            check_python();
            try {
                field.add(content == nullptr ? py::handle(Py_None) : py::handle(content), out);
            } catch (const py::value_error& error) {
                throw py::value_error(std::string(field.name) + ": " + error.what());
            }
        }
    }

  private:
    std::vector<Field> fields_;
};

}  // namespace mag_tracking
