// The rendering loss of a batch of views and its gradients: mean absolute difference, 1 − SSIM, relative LiDAR depth. The
// torch code in loss.py and ssim.py is its oracle. A view is computed by one thread in a fixed order, so every result has
// the same bits at any number of threads.
//
// SSIM takes two passes of blurs: of x, x², xy for the map of SSIM, then of that map's derivatives for the gradient. Both
// run down the image together, a few rows apart, so that the rows between them stay in the second-level cache.
#include <algorithm>
#include <atomic>
#include <cfloat>
#include <cmath>
#include <cstring>
#include <memory>

#include "../compiled/runtime.h"
#include "../compiled/vectors.h"

#define UNROLLED _Pragma("GCC unroll 16")
typedef float Vector __attribute__((vector_size(VECTOR_BYTES)));

constexpr int WIDTH = VECTOR_BYTES / 4;
constexpr int TAPS = 2 * RADIUS + 1, MARGIN = 3 * RADIUS;  // floats: rows are RGB RGB …, a pixel's neighbour is 3 away
constexpr int BLOCK = 4;                                   // rows blurred at once: a row is loaded once for all of them
constexpr int LAG = (RADIUS + BLOCK - 1) / BLOCK;          // blocks between a blur's input and its output
constexpr int RING = (LAG + 1) * BLOCK + (RADIUS + BLOCK - 1) / BLOCK * BLOCK;  // rows that are still needed
constexpr int LANES = 16;                                  // rows are padded to this with zeros; sums have as many parts

static inline Vector load(const float* p) {
  Vector v;
  std::memcpy(&v, p, sizeof v);
  return v;
}
static inline void store(float* p, Vector v) { std::memcpy(p, &v, sizeof v); }

struct Window {
  float tap[TAPS];
  Window() {
    double sum = 0, t[TAPS];
    for (int k = 0; k < TAPS; k++) sum += t[k] = std::exp(-(k - RADIUS) * (k - RADIUS) / (2. * SIGMA * SIGMA));
    for (int k = 0; k < TAPS; k++) tap[k] = (float)(t[k] / sum);
  }
};

// Zeroed memory, aligned to a cache line.
class Floats {
 public:
  explicit Floats(size_t n) : p_(static_cast<float*>(std::aligned_alloc(64, (n / 16 + 1) * 64))) {
    if (!p_) throw std::bad_alloc();
    std::fill(p_.get(), p_.get() + n, 0.f);
  }
  float* operator+(size_t i) const { return p_.get() + i; }

 private:
  struct Free { void operator()(float* p) const { std::free(p); } };
  std::unique_ptr<float, Free> p_;
};

// The last rows of some planes of an image, and their blur; zeros outside of the image.
class Blur {
 public:
  Blur(int planes, int height, int stride)
      : planes_(planes), height_(height), stride_(stride), rows_((size_t)(RING * planes + 1) * stride),
        between_((size_t)stride + 2 * LANES), out_((size_t)BLOCK * planes * stride) {}

  float* row(int r, int plane) const { return rows_ + (size_t)(r % RING * planes_ + plane) * stride_; }
  const float* blurred(int b, int plane) const { return out_ + (size_t)(b * planes_ + plane) * stride_; }

  // Of the BLOCK rows from `first` on, from rows up to RADIUS away.
  void run(int first, const Window& window) const {
    static_assert(MARGIN <= LANES, "the margins of `between_`");
    for (int plane = 0; plane < planes_; plane++) {
      const float* in[BLOCK + TAPS - 1];
      for (int k = 0; k < BLOCK + TAPS - 1; k++) {
        const int r = first + k - RADIUS;
        in[k] = r < 0 || r >= height_ ? rows_ + (size_t)RING * planes_ * stride_ : row(r, plane);
      }
      float* vertical[BLOCK];
      for (int b = 0; b < BLOCK; b++) vertical[b] = out_ + (size_t)(b * planes_ + plane) * stride_;
      for (int j = 0; j < stride_; j += WIDTH) {
        Vector sum[BLOCK] = {};
        UNROLLED for (int k = 0; k < BLOCK + TAPS - 1; k++) {
          const Vector v = load(in[k] + j);
          UNROLLED for (int b = 0; b < BLOCK; b++)
            if (k >= b && k - b < TAPS) sum[b] += window.tap[k - b] * v;
        }
        UNROLLED for (int b = 0; b < BLOCK; b++) store(vertical[b] + j, sum[b]);
      }
      for (int b = 0; b < BLOCK; b++) horizontal(vertical[b], window);
    }
  }

 private:
  // In place.
  void horizontal(float* row, const Window& window) const {
    std::memcpy(between_ + LANES, row, 4 * (size_t)stride_);
    const float* from = between_ + (LANES - MARGIN);
    for (int j = 0; j < stride_; j += WIDTH) {
      Vector sum = {};
      UNROLLED for (int k = 0; k < TAPS; k++) sum += window.tap[k] * load(from + j + 3 * k);
      store(row + j, sum);
    }
  }

  int planes_, height_, stride_;
  Floats rows_, between_, out_;
};

// A sum over many rows, in double precision.
class Sum {
 public:
  // A multiple of LANES entries.
  void add(const float* row, int n) {
    double lane[LANES];
    std::copy(lane_, lane_ + LANES, lane);
    for (int j = 0; j < n; j += LANES)
      for (int k = 0; k < LANES; k++) lane[k] += row[j + k];
    std::copy(lane, lane + LANES, lane_);
  }
  double total() const {
    double sum = 0;
    for (double x : lane_) sum += x;
    return sum;
  }

 private:
  double lane_[LANES] = {};
};

// x, x², xy.
static void products(const float* __restrict x, const float* __restrict y, int n, float* __restrict copy,
                     float* __restrict square, float* __restrict product) {
  for (int j = 0; j < n; j++) copy[j] = x[j], square[j] = x[j] * x[j], product[j] = x[j] * y[j];
}

// y, y².
static void squares(const float* __restrict y, int n, float* __restrict copy, float* __restrict square) {
  for (int j = 0; j < n; j++) copy[j] = y[j], square[j] = y[j] * y[j];
}

static void variances(const float* __restrict mean, const float* __restrict square, int n, float* __restrict out) {
  for (int j = 0; j < n; j++) out[j] = square[j] - mean[j] * mean[j];
}

// SSIM of each entry from the local means of x, x², xy, and its derivatives by the three.
static void ssim_row(const float* __restrict mean, const float* __restrict square, const float* __restrict product,
                     const float* __restrict mean_y, const float* __restrict variance_y, int n, float* __restrict value,
                     float* __restrict by_mean, float* __restrict by_square, float* __restrict by_product) {
  for (int j = 0; j < n; j++) {
    const float m = mean[j], my = mean_y[j];
    const float luminance = 2 * (m * my) + C1, structure = 2 * (product[j] - m * my) + C2;
    const float level = my * my + m * m + C1, spread = (square[j] - m * m) + variance_y[j] + C2;
    const float inverse = 1 / (level * spread), v = luminance * structure * inverse;
    const float by_variance = -v * (level * inverse), by_covariance = 2 * luminance * inverse;
    value[j] = v;
    by_square[j] = by_variance;
    by_product[j] = by_covariance;
    by_mean[j] = my * (2 * structure * inverse - by_covariance) - 2 * m * (v * (spread * inverse) + by_variance);
  }
}

// The gradient of rgb · |x − y| − ssim · SSIM, without SSIM where its blurred derivatives are null.
static void gradient_row(const float* __restrict x, const float* __restrict y, int n, const float* __restrict a,
                         const float* __restrict b, const float* __restrict c, float rgb, float ssim,
                         float* __restrict difference, float* __restrict out) {
  for (int j = 0; j < n; j++) {
    const float d = x[j] - y[j];
    difference[j] = std::fabs(d);
    out[j] = d > 0 ? rgb : d < 0 ? -rgb : 0;
  }
  if (!a) return;
  for (int j = 0; j < n; j++) out[j] -= ssim * (2 * b[j] * x[j] + a[j] + y[j] * c[j]);
}

struct View {
  const float *color, *depth, *image;
  const float *mean, *variance;  // of the image; null where they are still to be computed
  const float* sparse;           // null where depth does not supervise
  double weight;
  double* terms;  // rgb, 1 − SSIM, depth
  float *by_color, *by_depth;
};

struct Weights {
  double rgb, ssim, depth;
};

static void color_terms(const View& v, const Weights& weights, int height, int width) {
  static const Window window;
  const int n = 3 * width, stride = (n + LANES - 1) / LANES * LANES;
  const bool structural = weights.ssim > 0;
  const double entries = (double)n * height;
  const float rgb = (float)(v.weight * weights.rgb / entries), ssim = (float)(v.weight * weights.ssim / entries);
  const bool known = v.mean && v.variance;
  const int blurred_height = structural ? height : 0, blurred_stride = structural ? stride : 0;
  const Blur moments(known ? 3 : 5, blurred_height, blurred_stride), maps(3, blurred_height, blurred_stride);
  const Floats value(stride), variance(stride);
  Sum of_difference, of_ssim;
  // Three stages on blocks of rows, each LAG blocks behind the one that it reads from.
  for (int entered = 0; entered < height + 2 * LAG * BLOCK; entered += BLOCK) {
    if (structural) {
      for (int r = entered; r < std::min(entered + BLOCK, height); r++) {
        const size_t at = (size_t)n * r;
        products(v.color + at, v.image + at, n, moments.row(r, 0), moments.row(r, 1), moments.row(r, 2));
        if (!known) squares(v.image + at, n, moments.row(r, 3), moments.row(r, 4));
      }
      const int mapped = entered - LAG * BLOCK;
      if (mapped >= 0 && mapped < height) moments.run(mapped, window);
      for (int r = std::max(mapped, 0); r < std::min(mapped + BLOCK, height); r++) {
        const int b = r - mapped;
        const size_t at = (size_t)n * r;
        const float* mean = known ? v.mean + at : moments.blurred(b, 3);
        if (!known) variances(mean, moments.blurred(b, 4), n, variance + 0);
        ssim_row(moments.blurred(b, 0), moments.blurred(b, 1), moments.blurred(b, 2), mean,
                 known ? v.variance + at : variance + 0, n, value + 0, maps.row(r, 0), maps.row(r, 1), maps.row(r, 2));
        of_ssim.add(value + 0, stride);
      }
    }
    const int done = entered - 2 * LAG * BLOCK;
    if (structural && done >= 0) maps.run(done, window);
    for (int r = std::max(done, 0); r < std::min(done + BLOCK, height); r++) {
      const int b = r - done;
      const size_t at = (size_t)n * r;
      gradient_row(v.color + at, v.image + at, n, structural ? maps.blurred(b, 0) : nullptr, maps.blurred(b, 1),
                   maps.blurred(b, 2), rgb, ssim, value + 0, v.by_color + at);
      of_difference.add(value + 0, stride);
    }
  }
  v.terms[0] = of_difference.total() / entries;
  v.terms[1] = structural ? 1 - of_ssim.total() / entries : 0;
}

// Without its weight: it needs the number of valid pixels first.
static int depth_row(const float* __restrict depth, const float* __restrict target, int width, float* __restrict value,
                     float* __restrict gradient) {
  int valid = 0;
  for (int j = 0; j < width; j++) {
    const float t = target[j], d = depth[j];
    const bool both = (t > 0) & (t <= FLT_MAX) & (d > 0);
    const float clamped = d > DEPTH_MIN_M ? d : DEPTH_MIN_M, ratio = t / clamped, error = ratio - 1;
    const float size = std::fabs(error), slope = error > 0 ? -ratio / clamped : error < 0 ? ratio / clamped : 0;
    value[j] = both ? (size < DEPTH_LOSS_MAX ? size : DEPTH_LOSS_MAX) : 0;
    gradient[j] = both & (size <= DEPTH_LOSS_MAX) & (d >= DEPTH_MIN_M) ? slope : 0;
    valid += both;
  }
  return valid;
}

static void depth_term(const View& v, const Weights& weights, int height, int width) {
  const size_t pixels = (size_t)height * width;
  v.terms[2] = 0;
  if (!v.sparse || !(weights.depth > 0)) {
    std::fill(v.by_depth, v.by_depth + pixels, 0.f);
    return;
  }
  const int stride = (width + LANES - 1) / LANES * LANES;
  const Floats value(stride);
  Sum sum;
  long long valid = 0;
  for (int r = 0; r < height; r++) {
    const size_t at = (size_t)width * r;
    valid += depth_row(v.depth + at, v.sparse + at, width, value + 0, v.by_depth + at);
    sum.add(value + 0, stride);
  }
  if (!valid) return;  // the gradient is zero everywhere
  v.terms[2] = sum.total() / valid;
  const float scale = (float)(v.weight * weights.depth / valid);
  for (size_t i = 0; i < pixels; i++) v.by_depth[i] *= scale;
}

// color [V, H, W, 3], depth [V, H, W]; images, means, variances: V pointers to [H, W, 3], of which the last two may be null;
// sparse: V pointers to [H, W] or null; weights [V]. Writes terms [V, 3] (before their weights; those without weight are 0),
// by_color and by_depth: the gradients of the sum of weights · (rgb, ssim, depth) · terms.
extern "C" int genre_image_loss(int views, int height, int width, const float* color, const float* depth,
                                const float* const* images, const float* const* means, const float* const* variances,
                                const float* const* sparse, const double* weights, double rgb, double ssim,
                                double depth_weight, int threads, double* terms, float* by_color, float* by_depth) {
  return guarded([&] {
    const Weights of_terms{rgb, ssim, depth_weight};
    const size_t pixels = (size_t)height * width;
    std::atomic<int> next{0};
    parallel(std::max(1, std::min(threads, views)), [&](int) {
      for (int i; (i = next++) < views;) {
        const View view{color + 3 * pixels * i, depth + pixels * i, images[i], means[i], variances[i], sparse[i],
                        weights[i], terms + 3 * i, by_color + 3 * pixels * i, by_depth + pixels * i};
        color_terms(view, of_terms, height, width);
        depth_term(view, of_terms, height, width);
      }
    });
  });
}
