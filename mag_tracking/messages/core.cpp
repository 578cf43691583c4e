// Python module of the CDR encoder; used by `types.py` only.

#include <tuple>

#include "cdr.hpp"

namespace mag_tracking {
namespace {

// Encoder of a built-in type; raises ValueError for any other type.
std::shared_ptr<const Value> built_in(const std::string& type, const py::object& given) {
    const py::object zero = type == "string" ? py::object(py::str("")) : py::object(py::int_(0));
    const auto of = [&](auto kind) -> std::shared_ptr<const Value> {
        return std::make_shared<Scalar<decltype(kind)>>(given.is_none() ? zero : given);
    };
    if (type == "float64") return of(Float<double>());
    if (type == "float32") return of(Float<float>());
    if (type == "int8") return of(Integer<std::int8_t>());
    if (type == "uint8" || type == "byte" || type == "char") return of(Integer<std::uint8_t>());
    if (type == "int16") return of(Integer<std::int16_t>());
    if (type == "uint16") return of(Integer<std::uint16_t>());
    if (type == "int32") return of(Integer<std::int32_t>());
    if (type == "uint32") return of(Integer<std::uint32_t>());
    if (type == "int64") return of(Integer<std::int64_t>());
    if (type == "uint64") return of(Integer<std::uint64_t>());
    if (type == "bool") return of(Boolean());
    if (type == "string") return of(String());
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
