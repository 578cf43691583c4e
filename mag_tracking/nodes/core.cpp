// Python module that ends the process after a timeout, even while Python is blocked. The arguments
// are described in core.pyi.

#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <thread>

#include "../python.hpp"

namespace mag_tracking {
namespace {

constexpr double MAX_S = 1e6;
// Number of bytes that a writable pipe accepts without blocking (PIPE_BUF).
constexpr std::size_t MAX_MESSAGE = 4096;

[[noreturn]] void end_process(int status, const std::string& message) {
    pollfd error_output{STDERR_FILENO, POLLOUT, 0};
    if (poll(&error_output, 1, 0) > 0) {
        // A failure is ignored, because the message cannot be written anywhere else.
        [[maybe_unused]] const auto written =
            write(STDERR_FILENO, message.data(), std::min(message.size(), MAX_MESSAGE));
    }
    _exit(status);
}

double checked(double seconds) {
    if (!(seconds >= 0.0 && seconds <= MAX_S))
        throw py::value_error("a deadline must be between 0 and 1e6 s");
    return seconds;
}

class Deadline {
  public:
    Deadline(double seconds, int status, const std::string& message)
        : seconds_(checked(seconds)), status_(status), message_(message),
          thread_([this] { watch(); }) {}
    Deadline(const Deadline&) = delete;
    Deadline& operator=(const Deadline&) = delete;
    ~Deadline() { cancel(); }

    // The thread holds no lock that the caller may need, so joining it cannot block.
    void cancel() {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            cancelled_ = true;
        }
        changed_.notify_all();
        if (thread_.joinable()) thread_.join();
    }

  private:
    void watch() {
        std::unique_lock<std::mutex> lock(mutex_);
        if (!changed_.wait_for(lock, std::chrono::duration<double>(seconds_), [this] {
            return cancelled_;
        }))
            end_process(status_, message_);
    }

    const double seconds_;
    const int status_;
    const std::string message_;
    std::mutex mutex_;
    std::condition_variable changed_;
    bool cancelled_ = false;
    // Declared last, because the thread uses all other members.
    std::thread thread_;
};

}  // namespace

PYBIND11_MODULE(core, m) {
    py::class_<Deadline>(m, "Deadline")
        .def(py::init<double, int, const std::string&>(), py::arg("seconds"), py::arg("status"),
             py::arg("message"))
        .def("cancel", &Deadline::cancel);
    m.def("end_within", [](double seconds, int status, const std::string& message) {
        // Never deleted, because it must outlive the interpreter.
        new Deadline(seconds, status, message);
    }, py::arg("seconds"), py::arg("status"), py::arg("message"));
}

}  // namespace mag_tracking
