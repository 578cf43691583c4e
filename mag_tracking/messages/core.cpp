// What of messages is compiled, as a Python module. `types.py` is its only user.

#include <tuple>

#include "cdr.hpp"

namespace mag_tracking {
namespace {

template <class T>
std::shared_ptr<const Value> value_of(const py::handle& standard, const py::handle& zero) {
    return std::make_shared<T>(standard.is_none() ? zero : standard);
}

// A value of a built-in type; raises ValueError for others.
std::shared_ptr<const Value> built_in(const std::string& type, const py::object& standard) {
    const py::int_ zero(0);
    if (type == "float64") return value_of<Float<double>>(standard, zero);
    if (type == "float32") return value_of<Float<float>>(standard, zero);
    if (type == "int8") return value_of<Whole<std::int8_t>>(standard, zero);
    if (type == "uint8" || type == "byte" || type == "char")
        return value_of<Whole<std::uint8_t>>(standard, zero);
    if (type == "int16") return value_of<Whole<std::int16_t>>(standard, zero);
    if (type == "uint16") return value_of<Whole<std::uint16_t>>(standard, zero);
    if (type == "int32") return value_of<Whole<std::int32_t>>(standard, zero);
    if (type == "uint32") return value_of<Whole<std::uint32_t>>(standard, zero);
    if (type == "int64") return value_of<Whole<std::int64_t>>(standard, zero);
    if (type == "uint64") return value_of<Whole<std::uint64_t>>(standard, zero);
    if (type == "bool") return value_of<Truth>(standard, zero);
    if (type == "string") return value_of<Text>(standard, py::str(""));
    throw py::value_error("a type that cannot be written: " + type);
}

// Writes the messages of one type.
class Encoder {
  public:
    // Of each field the name, the length of an array or what else it is, a built-in type or the
    // Encoder of a message, and the default or None.
    explicit Encoder(const std::vector<std::tuple<py::str, Size, py::object, py::object>>& fields) {
        std::vector<Field> out;
        for (const auto& [name, length, type, standard] : fields)
            out.push_back({name, py::isinstance<Encoder>(type)
                                     ? type.cast<const Encoder&>().message_
                                     : built_in(type.cast<std::string>(), standard), length});
        message_ = std::make_shared<Message>(std::move(out));
    }

    py::bytes encode(const py::dict& message) const {
        Bytes out;
        message_->add(message, out);
        return out.done();
    }

  private:
    std::shared_ptr<const Value> message_;
};

}  // namespace
}  // namespace mag_tracking

PYBIND11_MODULE(core, module) {
    using namespace mag_tracking;
    module.doc() = "The bytes of messages, compiled; see types.py.";
    py::class_<Encoder>(module, "Encoder")
        .def(py::init<const std::vector<std::tuple<py::str, Size, py::object, py::object>>&>(),
             py::arg("fields"))
        .def("__call__", &Encoder::encode, py::arg("message"));
    module.attr("SEQUENCE") = Field::SEQUENCE;
    module.attr("ONE") = Field::ONE;
}
