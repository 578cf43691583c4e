// Python module of the CDR encoder; used by `types.py` only.

#include <tuple>

#include "cdr.hpp"

namespace mag_tracking {
namespace {

template <class T>
std::shared_ptr<const Value> value_of(const py::handle& default_value, const py::handle& zero) {
    return std::make_shared<T>(default_value.is_none() ? zero : default_value);
}

// Encoder of a built-in type; raises ValueError for any other type.
std::shared_ptr<const Value> built_in(const std::string& type, const py::object& default_value) {
    const py::int_ zero(0);
    if (type == "float64") return value_of<Float<double>>(default_value, zero);
    if (type == "float32") return value_of<Float<float>>(default_value, zero);
    if (type == "int8") return value_of<Integer<std::int8_t>>(default_value, zero);
    if (type == "uint8" || type == "byte" || type == "char")
        return value_of<Integer<std::uint8_t>>(default_value, zero);
    if (type == "int16") return value_of<Integer<std::int16_t>>(default_value, zero);
    if (type == "uint16") return value_of<Integer<std::uint16_t>>(default_value, zero);
    if (type == "int32") return value_of<Integer<std::int32_t>>(default_value, zero);
    if (type == "uint32") return value_of<Integer<std::uint32_t>>(default_value, zero);
    if (type == "int64") return value_of<Integer<std::int64_t>>(default_value, zero);
    if (type == "uint64") return value_of<Integer<std::uint64_t>>(default_value, zero);
    if (type == "bool") return value_of<Boolean>(default_value, zero);
    if (type == "string") return value_of<String>(default_value, py::str(""));
    throw py::value_error("type cannot be encoded: " + type);
}

// Encodes the messages of one type.
class Encoder {
  public:
    // Each field is (name, length of a fixed-size array or SEQUENCE or ONE, name of a built-in type
    // or Encoder of a message, default or None).
    explicit Encoder(const std::vector<std::tuple<py::str, Size, py::object, py::object>>& fields) {
        std::vector<Field> out;
        for (const auto& [name, length, type, default_value] : fields)
            out.push_back(
                {name,
                 py::isinstance<Encoder>(type) ? type.cast<const Encoder&>().message_
                                               : built_in(type.cast<std::string>(), default_value),
                 length});
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
    module.doc() = "Encoding of messages as CDR bytes; see types.py.";
    py::class_<Encoder>(module, "Encoder")
        .def(py::init<const std::vector<std::tuple<py::str, Size, py::object, py::object>>&>(),
             py::arg("fields"))
        .def("__call__", &Encoder::encode, py::arg("message"));
    module.attr("SEQUENCE") = Field::SEQUENCE;
    module.attr("ONE") = Field::ONE;
}
