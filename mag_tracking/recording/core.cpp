// Python module of compiled functions that locate the records of MCAP chunks and format numbers;
// core.pyi documents the arguments.

#include <algorithm>
#include <charconv>
#include <cmath>
#include <string_view>

#include "../python.hpp"

namespace mag_tracking {
namespace {

constexpr std::uint8_t SCHEMA = 3, CHANNEL = 4, MESSAGE = 5;
// A record begins with opcode and length. Message data follow channel, sequence number, log time
// and publish time.
constexpr std::size_t RECORD_HEADER = 9, MESSAGE_HEADER = 22;
// Schemas and channels have 16-bit numbers.
constexpr std::size_t MAX_DEFINITIONS = 1 << 17;

// MCAP is little-endian.
template <class T>
T number_at(const char* p) {
    T value = 0;
    for (std::size_t i = 0; i < sizeof(T); ++i)
        value |= T(static_cast<unsigned char>(p[i])) << (8 * i);
    return value;
}

[[noreturn]] void raise_damaged(const char* message) {
    PyErr_SetString(PyExc_EOFError, message);
    throw py::error_already_set();
}

py::tuple records_of(const py::bytes& data, std::int64_t latest_ns, std::size_t max_messages) {
    const std::string_view all = data;
    std::vector<std::int64_t> rows;
    py::list definitions;
    std::size_t at = 0;
    while (all.size() - at >= RECORD_HEADER) {
        const auto kind = static_cast<std::uint8_t>(all[at]);
        const auto length = number_at<std::uint64_t>(all.data() + at + 1);
        const std::size_t begin = at + RECORD_HEADER;
        if (length > all.size() - begin) break;
        const std::size_t end = begin + length;
        if (kind == MESSAGE) {
            if (length < MESSAGE_HEADER) raise_damaged("message is shorter than its header");
            if (rows.size() / 4 == max_messages) throw py::value_error("too many messages");
            const char* p = all.data() + begin;
            const auto log_time = number_at<std::uint64_t>(p + 6);
            rows.insert(rows.end(), {std::int64_t(number_at<std::uint16_t>(p)),
                                     std::int64_t(std::min<std::uint64_t>(log_time, latest_ns)),
                                     std::int64_t(begin + MESSAGE_HEADER), std::int64_t(end)});
        } else if (kind == SCHEMA || kind == CHANNEL) {
            if (definitions.size() == MAX_DEFINITIONS) throw py::value_error("too many channels");
            definitions.append(py::make_tuple(int(kind), begin, end));
        }
        at = end;
    }
    const Size n = Size(rows.size() / 4);
    Integers out({n, Size(4)});
    std::copy(rows.begin(), rows.end(), out.mutable_data());
    return py::make_tuple(out, definitions, at);
}

// Append the shortest decimal representation that is parsed to the same number.
void append(std::string& text, double value) {
    if (std::isnan(value)) {
        text += "nan";
        return;
    }
    char digits[32];
    text.append(digits, std::to_chars(digits, digits + sizeof digits, value).ptr);
}

py::list number_rows(Array values) {
    const Size n = length_of(values, "values", 2), m = values.shape(1);
    const double* v = input_of(values, "values", {n, m});
    py::list rows(n);
    std::string row;
    for (Size i = 0; i < n; ++i, v += m) {
        row.clear();
        for (Size k = 0; k < m; ++k) {
            if (k) row += ',';
            append(row, v[k]);
        }
        rows[i] = py::str(row);
    }
    return rows;
}

}  // namespace
}  // namespace mag_tracking

PYBIND11_MODULE(core, m) {
    using namespace mag_tracking;
    m.doc() = "Compiled functions that locate the records of MCAP chunks and format numbers.";
    m.def("number_rows", &number_rows, IN(values));
    m.def("records_of", &records_of, py::arg("data"), py::arg("latest_ns"),
          py::arg("max_messages"));
}
