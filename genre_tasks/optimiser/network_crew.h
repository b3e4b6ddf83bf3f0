// Threads that live for one evaluation and go through its phases together.
#pragma once
#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

// Which thread does a piece of a phase is left to chance; what is computed there is not.
class Crew {
 public:
  // work(worker) on up to `threads` threads, as many as can be had, of which this is one. It must not throw.
  template <class F>
  void run(int threads, F work) {
    std::vector<std::thread> others;
    others.reserve(std::max(0, threads - 1));
    std::unique_lock<std::mutex> gate(guard_);  // nobody begins before it is known how many there are
    for (int w = 1; w < threads; w++) {
      try {
        others.emplace_back([this, w, &work] {
          { std::lock_guard<std::mutex> wait(guard_); }
          work(w);
        });
      } catch (const std::system_error&) {
        break;
      }
    }
    size_ = 1 + (int)others.size();
    gate.unlock();
    work(0);
    for (auto& t : others) t.join();
  }

  // A phase: piece(i) for each i in [0, pieces), and nobody goes on before all are done.
  template <class F>
  void each(size_t pieces, F piece) {
    for (size_t i; (i = next_.fetch_add(1, std::memory_order_relaxed)) < pieces;) piece(i);
    wait();
  }

 private:
  static constexpr int PATIENCE = 100;
  std::mutex guard_;
  std::condition_variable all_here_;
  int size_ = 1, arrived_ = 0;
  std::atomic<uint64_t> phase_{0};
  std::atomic<size_t> next_{0};

  void wait() {
    const uint64_t phase = phase_.load();
    {
      std::lock_guard<std::mutex> lock(guard_);
      if (++arrived_ == size_) {
        arrived_ = 0, next_ = 0;
        phase_.store(phase + 1);
        all_here_.notify_all();
        return;
      }
    }
    for (int i = 0; i < PATIENCE; i++) {  // phases are short: sleeping and waking would cost more than some of them
      if (phase_.load() != phase) return;
      std::this_thread::yield();
    }
    std::unique_lock<std::mutex> lock(guard_);
    all_here_.wait(lock, [&] { return phase_.load() != phase; });
  }
};
