// Tasks shared by the threads of a pool and the one that asks.
#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <memory>
#include <thread>

#include "xla/ffi/api/ffi.h"

namespace jaxmark {

class Crew {
 public:
  explicit Crew(xla::ffi::ThreadPool pool) : pool_(pool) {}

  int64_t threads() const { return std::max<int64_t>(pool_.num_threads(), 1); }

  // Runs task(0) … task(count - 1), and returns when all are done. Whoever is free claims the next one; the caller
  // does what nobody claims, so that a pool whose threads all wait does not stop it.
  void Run(int64_t count, const std::function<void(int64_t)>& task) {
    if (count <= 1) {
      if (count == 1) task(0);
      return;
    }
    // Helpers that come too late find nothing to claim, and do not touch the task any more.
    struct Shared {
      std::atomic<int64_t> next{0}, done{0};
    };
    auto shared = std::make_shared<Shared>();
    const std::function<void(int64_t)>* work = &task;
    std::function<void()> help = [shared, work, count] {
      for (int64_t i; (i = shared->next.fetch_add(1)) < count;) {
        (*work)(i);
        shared->done.fetch_add(1);
      }
    };
    for (int64_t i = 1; i < count; ++i) pool_.Schedule(std::function<void()>(help));
    help();
    for (int turns = 0; shared->done.load() < count; ++turns) {
      if (turns > 1000) std::this_thread::yield();
    }
  }

 private:
  xla::ffi::ThreadPool pool_;
};

}  // namespace jaxmark
