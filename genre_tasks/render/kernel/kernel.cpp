// The CPU rasteriser behind a plain C interface. Every result has the same bits at any number of threads.
#include <map>

#include "../../compiled/runtime.h"
#include "spherical_harmonics.h"
#include "view.h"

// Never destroyed: a handle may be freed while the process ends.
static MemoryPool<View>& view_pool() { static auto* s = new MemoryPool<View>; return *s; }
static MemoryPool<Scratch>& scratch_pool() { static auto* s = new MemoryPool<Scratch>; return *s; }
static MemoryPool<GradientList>& gradient_list_pool() { static auto* s = new MemoryPool<GradientList>; return *s; }

struct Gradients {
  float *means, *scales, *quats, *opacities, *colors;
  size_t color_step;  // from a view's colours to the next one's; 0: all views have the same
  float* residual_sums;  // [N, RESIDUAL_SUMS] of a residual image, or null

  void clear(size_t count, size_t views, int threads) {
    const size_t color_entries = color_step ? 3 * views : 3;
    const std::pair<float*, size_t> all[] = {{means, 3}, {scales, 3}, {quats, 4}, {opacities, 1}, {colors, color_entries},
                                             {residual_sums, residual_sums ? RESIDUAL_SUMS : 0}};
    for (auto [p, entries] : all) prefer_huge_pages(p, 4 * entries * count);
    parallel(threads, [&](int w) {
      for (auto [p, entries] : all)
        std::fill(p + work_begin(entries * count, w, threads), p + work_begin(entries * count, w + 1, threads), 0.f);
    });
  }
  void add(const GradientList& list, int view) {
    float* view_color = colors + color_step * view;
    for (size_t at = 0; at < list.id.size(); at++) {
      auto x = [&](int k) { return list.gradient[at / LANES * list.rows + k][(int)(at % LANES)]; };
      const size_t i = list.id[at];
      for (int k = 0; k < 3; k++)
        means[3 * i + k] += x(MEAN + k), scales[3 * i + k] += x(SCALE + k), view_color[3 * i + k] += x(COLOR + k);
      for (int k = 0; k < 4; k++) quats[4 * i + k] += x(QUAT + k);
      opacities[i] += x(OPACITY);
      if (residual_sums)
        for (int k = 0; k < RESIDUAL_SUMS; k++) residual_sums[RESIDUAL_SUMS * i + k] += x(ATTRIBUTES + k);
    }
  }
};

// What the backward pass of V views needs of the forward pass.
struct ForwardState {
  std::vector<std::unique_ptr<View>> views;
};

// Calls work(view, worker, threads inside): views side by side on a thread each, as many as are a multiple of the threads; the
// rest one by one, with all threads inside.
template <class F>
static void for_each_view(int views, int threads, F work) {
  const int side_by_side = threads > 1 ? views / threads * threads : 0;
  std::atomic<int> next{0};
  if (side_by_side) parallel(threads, [&](int w) {
    for (int v; (v = next++) < side_by_side;) work(v, w, 1);
  });
  for (int v = side_by_side; v < views; v++) work(v, 0, threads);
}

// Adds up the views' gradients in the order of the views, so that sums do not depend on threads. No thread waits: gradients
// that come before their turn are stored.
class OrderedGradientSum {
 public:
  explicit OrderedGradientSum(Gradients sum) : sum_(sum) {}
  void add(int view, Scratch& s, int threads) {
    if (threads > 1) {  // the only view in work: each thread has Gaussians of its own
      parallel(threads, [&](int w) { sum_.add(*s.gradients[w], view); });
      next_ = view + 1;
      return;
    }
    std::lock_guard<std::mutex> lock(guard_);
    waiting_[view] = std::exchange(s.gradients[0], gradient_list_pool().take());
    auto first = waiting_.begin();
    for (; first != waiting_.end() && first->first == next_; first = waiting_.erase(first), next_++) {
      sum_.add(*first->second, first->first);
      gradient_list_pool().give(std::move(first->second));
    }
  }

 private:
  Gradients sum_;
  std::mutex guard_;
  std::map<int, std::unique_ptr<GradientList>> waiting_;
  int next_ = 0;
};

// Scratch memory for n threads, for one call.
struct ScratchSet {
  std::vector<std::unique_ptr<Scratch>> of;
  explicit ScratchSet(int n) { while (n--) of.push_back(scratch_pool().take()); }
  ~ScratchSet() {
    for (; !of.empty(); of.pop_back()) scratch_pool().give(std::move(of.back()));  // the first is taken first again
  }
};

extern "C" {

// poses [V, 4, 4] chunk to camera, lenses [V, 4], distortions [V, 10] or null, shutters [V, 7] or null, as make_camera takes
// them, and `antialiased` for all; velocities [N, 3] or null; colors [N, 3], or with colors_by_view [V, N, 3].
// Writes color [V, H, W, 3], alpha and depth [V, H, W]. A view shows the first `shared` Gaussians and those of its range (begin
// and end) in ranges [V, 2]. culled [5] is added to. With `state`, what genre_backward needs is stored there until genre_free.
int genre_forward(int count, const float* means, const float* scales, const float* quats, const float* opacities,
                  const float* colors, int colors_by_view, const float* velocities, int views, const float* poses,
                  const float* lenses, const float* distortions, const float* shutters, int antialiased, int width, int height,
                  int threads, int shared, const int* ranges, float* color, float* alpha, float* depth, long long* culled,
                  void** state) {
  return guarded([&] {
    const size_t color_step = colors_by_view ? 3 * (size_t)count : 0;
    ScratchSet scratch(std::max(1, threads));
    auto result = std::make_unique<ForwardState>();
    result->views.resize(views);
    size_t pixels = (size_t)width * height;
    prefer_huge_pages(color, 12 * pixels * views), prefer_huge_pages(alpha, 4 * pixels * views);
    prefer_huge_pages(depth, 4 * pixels * views);
    std::mutex counting;
    for_each_view(views, std::max(1, threads), [&](int v, int w, int inside) {
      const GaussianArrays in{count, means, scales, quats, opacities, colors + color_step * v, velocities};
      auto view = view_pool().take();
      view->camera = make_camera(poses + 16 * v, lenses + 4 * v, distortions ? distortions + 10 * v : nullptr,
                                 shutters ? shutters + 7 * v : nullptr, antialiased, width, height);
      view->visible = {(uint32_t)shared, (uint32_t)ranges[2 * v], (uint32_t)(ranges[2 * v + 1] - ranges[2 * v])};
      view->tiles_x = (width + TILE - 1) / TILE, view->tiles_y = (height + TILE - 1) / TILE;
      forward(*view, *scratch.of[w], in, inside, color + 3 * pixels * v, alpha + pixels * v, depth + pixels * v);
      std::lock_guard<std::mutex> lock(counting);
      for (int r = 0; r < CULL_REASONS; r++) culled[r] += view->culled[r];
      if (state) result->views[v] = std::move(view);
      else view_pool().give(std::move(view));
    });
    if (state) *state = result.release();
  });
}

// `color`, `alpha`, `depth` are what genre_forward wrote. With a `residual` [V, H, W, 3], residual_sums [N, 5] gets the sums
// over pixels and views of w r, w |r|^2 and w, where w is a Gaussian's weight in the pixel times the view's in view_weights [V]
// (null: 1); else both are null.
int genre_backward(void* state, int count, const float* means, const float* scales, const float* quats,
                   const float* opacities, const float* colors, int colors_by_view, const float* velocities, const float* color,
                   const float* alpha, const float* depth, const float* v_color, const float* v_alpha, const float* v_depth,
                   const float* residual, const float* view_weights, int threads, float* grad_means, float* grad_scales,
                   float* grad_quats, float* grad_opacities, float* grad_colors, float* residual_sums) {
  return guarded([&] {
    auto& views = static_cast<ForwardState*>(state)->views;
    const size_t color_step = colors_by_view ? 3 * (size_t)count : 0;
    Gradients g{grad_means, grad_scales, grad_quats, grad_opacities, grad_colors, color_step, residual_sums};
    g.clear((size_t)count, views.size(), std::max(1, threads));
    ScratchSet scratch(std::max(1, threads));
    OrderedGradientSum sum(g);
    for_each_view((int)views.size(), std::max(1, threads), [&](int v, int w, int inside) {
      const GaussianArrays in{count, means, scales, quats, opacities, colors + color_step * v, velocities};
      size_t at = (size_t)views[v]->camera.width * views[v]->camera.height * v;
      backward(*views[v], *scratch.of[w], in, inside, Images{color + 3 * at, alpha + at, depth + at},
               Images{v_color + 3 * at, v_alpha + at, v_depth + at}, residual ? residual + 3 * at : nullptr,
               view_weights ? view_weights[v] : 1.f);
      sum.add(v, *scratch.of[w], inside);
    });
  });
}

// See ShGaussians and the two functions of spherical_harmonics.h.
int genre_sh_colors(const ShGaussians* in, int threads, float* view_colors) {
  return guarded([&] { sh_colors_forward(*in, threads, view_colors); });
}

int genre_sh_colors_backward(const ShGaussians* in, int threads, const float* view_colors, const float* grad_view_colors,
                             float* grad_means, float* grad_colors, float* grad_coefficients) {
  return guarded([&] {
    sh_colors_backward(*in, threads, view_colors, grad_view_colors, grad_means, grad_colors, grad_coefficients);
  });
}

// Adds to work [4] what the forward pass did: footprints drawn, (tile, footprint) pairs, pixels computed, pixels changed.
int genre_work(void* state, long long* work) {
  return guarded([&] {
    for (auto& view : static_cast<ForwardState*>(state)->views) {
      View& v = *view;
      std::vector<float> image((size_t)v.camera.width * v.camera.height * 5);
      float* alpha = image.data() + image.size() / 5 * 3;
      work[3] += blend<true>(v, 1, image.data(), alpha, alpha + image.size() / 5);
      work[0] += v.drawn, work[1] += v.pairs.n;
      for (size_t t = 0; t < v.pairs_taken.n; t++)
        for (int i = 0; i < v.pairs_taken[t]; i++) work[2] += LANES * __builtin_popcount(v.visited[v.tile_begin[t] + i]);
    }
  });
}

void genre_free(void* state) {
  auto* forward_state = static_cast<ForwardState*>(state);
  for (auto& v : forward_state->views) view_pool().give(std::move(v));
  delete forward_state;
}

// Gives back the memory that waits for later calls: up to MemoryPool's LIMIT of each kind.
void genre_release() { view_pool().clear(), scratch_pool().clear(), gradient_list_pool().clear(); }
}
