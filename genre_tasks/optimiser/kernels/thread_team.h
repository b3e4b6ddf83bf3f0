// Threads that live for one evaluation and go through its phases together.
#pragma once
#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstddef>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

// Which thread does a piece of a phase is left to chance; what is computed there is not. A phase waits for its pieces and not
// for threads, so that a thread that the machine has no time for delays no other.
class ThreadTeam {
  struct alignas(64) Phase {
    std::atomic<size_t> taken{0}, done{0};
  };

 public:
  // What a thread knows of its place in the sequence of phases.
  class Member {
   public:
    const int number;
    Member(ThreadTeam& team, int number) : number(number), team_(team) {}

    // A phase: piece(i) for each i in [0, pieces), and no member goes on before all are done.
    template <class F>
    void each(size_t pieces, F piece) {
      Phase& phase = team_.phases_[at_++];
      size_t mine = 0;
      for (size_t i; (i = phase.taken.fetch_add(1, std::memory_order_relaxed)) < pieces; mine++) piece(i);
      if (mine && phase.done.fetch_add(mine) + mine == pieces) team_.wake();
      team_.wait([&] { return phase.done.load() == pieces; });
    }

   private:
    ThreadTeam& team_;
    size_t at_ = 0;
  };

  explicit ThreadTeam(size_t phases) : phases_(phases) {}

  // work(member) on up to `threads` threads, as many as can be had, of which this is one. It must not throw.
  template <class F>
  void run(int threads, F work) {
    std::vector<std::thread> others;
    others.reserve(std::max(0, threads - 1));
    for (int w = 1; w < threads; w++) {
      try {
        others.emplace_back([this, w, &work] { Member member(*this, w); work(member); });
      } catch (const std::exception&) {
        break;
      }
    }
    Member first(*this, 0);
    work(first);
    for (auto& t : others) t.join();
  }

 private:
  static constexpr int PATIENCE = 100;
  std::vector<Phase> phases_;
  std::mutex guard_;
  std::condition_variable done_;

  void wake() {
    { std::lock_guard<std::mutex> lock(guard_); }  // nobody is between looking and sleeping
    done_.notify_all();
  }
  template <class F>
  void wait(F over) {
    for (int i = 0; i < PATIENCE; i++) {  // phases are short: sleeping and waking would cost more than some of them
      if (over()) return;
      std::this_thread::yield();
    }
    std::unique_lock<std::mutex> lock(guard_);
    done_.wait(lock, over);
  }
};
