// What has to happen even while Python is held up, as a Python module; core.pyi says what the
// arguments are.

#include <unistd.h>

#include <chrono>
#include <condition_variable>
#include <mutex>
#include <thread>

#include "../python.hpp"

namespace mag_tracking {
namespace {

class Deadline {
  public:
    Deadline(double seconds, int status, const std::string& message)
        : thread_([this, seconds, status, message] { watch(seconds, status, message); }) {}
    Deadline(const Deadline&) = delete;
    Deadline& operator=(const Deadline&) = delete;
    ~Deadline() { cancel(); }

    // The thread takes nothing that the caller may hold, so that waiting for it is safe.
    void cancel() {
        {
            const std::lock_guard<std::mutex> lock(mutex_);
            cancelled_ = true;
        }
        changed_.notify_all();
        if (thread_.joinable()) thread_.join();
    }

  private:
    void watch(double seconds, int status, const std::string& message) {
        std::unique_lock<std::mutex> lock(mutex_);
        if (changed_.wait_for(lock, std::chrono::duration<double>(seconds),
                              [this] { return cancelled_; }))
            return;
        // Nobody is left to be told of a message that cannot be written.
        [[maybe_unused]] const auto written = write(STDERR_FILENO, message.data(), message.size());
        _exit(status);
    }

    std::mutex mutex_;
    std::condition_variable changed_;
    bool cancelled_ = false;
    // The last, as it begins with the others in place.
    std::thread thread_;
};

}  // namespace

PYBIND11_MODULE(core, m) {
    py::class_<Deadline>(m, "Deadline")
        .def(py::init<double, int, const std::string&>(), py::arg("seconds"), py::arg("status"),
             py::arg("message"))
        .def("cancel", &Deadline::cancel);
}

}  // namespace mag_tracking
