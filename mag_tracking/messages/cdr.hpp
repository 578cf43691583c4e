// CDR, the bytes of ROS messages, from nested dicts of Python.
//
// Source: OMG DDS-XTypes 1.3, section 7.4.1 (XCDR version 1), little endian.

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

static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "numbers are written as they are");

namespace mag_tracking {

// What is written; numbers begin at a multiple of their size behind the header.
class Bytes {
  public:
    Bytes() : data_("\0\1\0\0", HEADER) {}

    template <class T>
    void add(T value) {
        data_.append((sizeof(T) - (data_.size() - HEADER) % sizeof(T)) % sizeof(T), '\0');
        data_.append(reinterpret_cast<const char*>(&value), sizeof(T));
    }

    void add_text(const std::string& text) {
        add_length(text.size() + 1);
        data_.append(text.c_str(), text.size() + 1);
    }

    void add_length(std::size_t n) {
        if (n > std::numeric_limits<std::uint32_t>::max())
            throw py::value_error("longer than CDR can say");
        add(std::uint32_t(n));
    }

    py::bytes done() const { return py::bytes(data_); }

  private:
    static constexpr std::size_t HEADER = 4;
    std::string data_;
};

// One kind of number or text, or a nested message.
class Value {
  public:
    virtual ~Value() = default;
    // `value` is what float(), int(), bool() or str() of Python takes; None: the default.
    virtual void add(const py::handle& value, Bytes& out) const = 0;
};

// Raises what Python has raised, if it has.
inline void check_python() {
    if (PyErr_Occurred()) throw py::error_already_set();
}

template <class T>
class Float : public Value {
  public:
    explicit Float(const py::handle& standard) : standard_(number(standard)) {}
    void add(const py::handle& value, Bytes& out) const override {
        out.add(value.is_none() ? standard_ : number(value));
    }

  private:
    static T number(const py::handle& value) {
        if (PyFloat_CheckExact(value.ptr())) return narrowed(PyFloat_AS_DOUBLE(value.ptr()));
        // As float() does, which takes text, too.
        const auto whole = py::reinterpret_steal<py::object>(PyNumber_Float(value.ptr()));
        check_python();
        return narrowed(PyFloat_AS_DOUBLE(whole.ptr()));
    }
    static T narrowed(double value) {
        if (std::isfinite(value) && std::abs(value) > double(std::numeric_limits<T>::max()))
            throw std::overflow_error("beyond the range of its type: " + std::to_string(value));
        return T(value);
    }
    T standard_;
};

template <class T>
class Whole : public Value {
  public:
    explicit Whole(const py::handle& standard) : standard_(number(standard)) {}
    void add(const py::handle& value, Bytes& out) const override {
        out.add(value.is_none() ? standard_ : number(value));
    }

  private:
    static T number(const py::handle& value) {
        const auto whole = py::reinterpret_steal<py::object>(
            PyLong_CheckExact(value.ptr()) ? value.inc_ref().ptr() : PyNumber_Long(value.ptr()));
        check_python();
        // Raises OverflowError beyond 64 bits.
        const auto wide = widest(whole.ptr(), std::is_signed<T>());
        check_python();
        if (wide < std::numeric_limits<T>::min() || wide > std::numeric_limits<T>::max())
            throw py::value_error("beyond the range of its type: " + std::to_string(wide));
        return T(wide);
    }
    static std::int64_t widest(PyObject* whole, std::true_type) { return PyLong_AsLongLong(whole); }
    static std::uint64_t widest(PyObject* whole, std::false_type) {
        return PyLong_AsUnsignedLongLong(whole);
    }
    T standard_;
};

class Truth : public Value {
  public:
    explicit Truth(const py::handle& standard) : standard_(is_true(standard)) {}
    void add(const py::handle& value, Bytes& out) const override {
        out.add(value.is_none() ? standard_ : is_true(value));
    }

  private:
    static bool is_true(const py::handle& value) {
        const int truth = PyObject_IsTrue(value.ptr());
        check_python();
        return truth != 0;
    }
    bool standard_;
};

class Text : public Value {
  public:
    explicit Text(const py::handle& standard) : standard_(py::str(standard)) {}
    void add(const py::handle& value, Bytes& out) const override {
        out.add_text(value.is_none() ? standard_ : std::string(py::str(value)));
    }

  private:
    std::string standard_;
};

// A field of a message.
struct Field {
    py::str name;
    std::shared_ptr<const Value> value;
    Size length;  // Of an array; SEQUENCE: it says so itself, ONE: it is none.

    static constexpr Size SEQUENCE = -1, ONE = -2;

    void add(const py::handle& content, Bytes& out) const {
        if (length == ONE) return value->add(content, out);
        // Text and dicts are sequences, too.
        if (PyUnicode_Check(content.ptr()) || PyDict_Check(content.ptr()))
            throw py::type_error(std::string(name) + ": not a list");
        const auto items = py::reinterpret_steal<py::object>(
            content.is_none() ? PyTuple_New(0) : PySequence_Fast(content.ptr(), "not a list"));
        check_python();
        const Size n = PySequence_Fast_GET_SIZE(items.ptr());
        if (length == SEQUENCE)
            out.add_length(n);
        else if (n && n != length)
            throw py::value_error(std::to_string(n) + " elements, not " + std::to_string(length));
        for (Size i = 0; i < (length == SEQUENCE ? n : length); ++i)
            value->add(n ? py::handle(PySequence_Fast_GET_ITEM(items.ptr(), i)) : Py_None, out);
    }
};

// A message: a dict of its fields. Those that are missing have their defaults.
class Message : public Value {
  public:
    explicit Message(std::vector<Field> fields) : fields_(std::move(fields)) {}

    void add(const py::handle& value, Bytes& out) const override {
        if (!value.is_none() && !PyDict_Check(value.ptr()))
            throw py::type_error("a message that is not a dict");
        // What has no fields has one byte: IDL knows no empty structure.
        if (fields_.empty()) out.add(std::uint8_t(0));
        for (const Field& field : fields_) {
            PyObject* content = value.is_none()
                ? nullptr : PyDict_GetItemWithError(value.ptr(), field.name.ptr());
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
