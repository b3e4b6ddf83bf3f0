// From the offsets of an unrolled optimisation to the splats that a renderer takes, and from the gradient of the splats to
// that of the offsets; expected depth and its gradient. The torch code in state.py, scene/graph.py, scene/gaussians.py and
// render/types.py is its oracle. Gaussians are taken in blocks that do not depend on threads, and each adds up its frames in
// their order: every result has the same bits at any number of threads.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "../../compiled/runtime.h"

constexpr int BLOCK = 64, ATTRIBUTES = 14, IMAGE_RESIDUALS = 5;
enum Attribute { MEAN = 0, SCALE = 3, QUAT = 6, OPACITY = 10, COLOR = 11 };

// An actor at a frame; where it is absent, it does not move.
struct Pose {
  float turn[9], shift[3], quat[4], present;
};

// What does not change over the iterations. A Gaussian that does not move has one splat, at `slot`. One of an actor has a splat
// for each frame: at `slot` for the first, and `moving` further for each next.
struct Gaussians {
  int64_t count, moving, actors;
  const float *start, *unit_m;    // [N, 14], [N]
  const int32_t *slot, *actor;    // [N]; the actor is -1 for what does not move
  const Pose* poses;              // [., actors]
};

struct Frames {
  int64_t count;
  const int64_t* at;  // [count] rows of the poses
};

struct Splats {
  float *means, *scales, *quats, *opacities, *colors;
};

// e^x within 2e-7, relative, from -87 to 88; constant below and above.
static inline float exponential(float x) {
  const float clamped = x < -87.f ? -87.f : x > LARGEST_LOG_SCALE ? LARGEST_LOG_SCALE : x;
  const float n = (clamped * 1.44269504f + 12582912.f) - 12582912.f;  // 1.5 * 2^23: rounds to the nearest integer
  const float r = (clamped - n * 0.693359375f) + n * 2.12194440e-4f;  // ln 2 in two parts
  float p = 1.9875691500e-4f;
  p = p * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  p = p * r * r + r + 1.f;
  const uint32_t bits = (uint32_t)((int32_t)n + 127) << 23;
  float power;
  std::memcpy(&power, &bits, 4);
  return p * power;
}

static inline float opacity_of(float exponent) { return 1.f / (1.f + exponent); }

// f(first, how many) for each block of Gaussians.
template <class F>
static void each_block(int64_t count, int threads, F f) {
  const int64_t blocks = (count + BLOCK - 1) / BLOCK;
  const int workers = (int)std::max<int64_t>(1, std::min<int64_t>(threads, blocks / 8));
  parallel(workers, [&](int w) {
    for (int64_t b = blocks * w / workers; b < blocks * (w + 1) / workers; b++)
      f(b * BLOCK, (int)std::min<int64_t>(BLOCK, count - b * BLOCK));
  });
}

template <int N>
static inline void put(float* to, const float* from) {
  for (int k = 0; k < N; k++) to[k] = from[k];
}

static void pose_block(const Gaussians& in, const Frames& frames, const float* offsets, int64_t first, int count,
                       const Splats& out, float* slopes) {
  float at[BLOCK][ATTRIBUTES], scales[BLOCK * 3], exponents[BLOCK] = {};
  std::fill(scales + 3 * count, scales + 3 * BLOCK, 0.f);
  for (int i = 0; i < count; i++) {
    const float *start = in.start + ATTRIBUTES * (first + i), *offset = offsets + ATTRIBUTES * (first + i);
    const float unit = in.unit_m[first + i];
    for (int k = 0; k < 3; k++) at[i][k] = start[k] + offset[k] * unit;
    for (int k = 3; k < ATTRIBUTES; k++) at[i][k] = start[k] + offset[k];
    for (int k = 0; k < 3; k++) scales[3 * i + k] = at[i][SCALE + k];
    exponents[i] = -(at[i][OPACITY] < LOWEST_LOGIT ? LOWEST_LOGIT : at[i][OPACITY]);
  }
  for (int i = 0; i < 3 * BLOCK; i++) scales[i] = exponential(scales[i]);
  for (int i = 0; i < BLOCK; i++) exponents[i] = exponential(exponents[i]);
  const float absent = opacity_of(exponential(-ABSENT_LOGIT));
  for (int i = 0; i < count; i++) {
    const float *x = at[i], *q = x + QUAT, opacity = opacity_of(exponents[i]);
    slopes[first + i] = x[OPACITY] >= LOWEST_LOGIT ? opacity * (opacity * exponents[i]) : 0.f;
    int64_t slot = in.slot[first + i];
    const int actor = in.actor[first + i];
    for (int64_t f = 0; f < (actor < 0 ? 1 : frames.count); f++, slot += in.moving) {
      put<3>(out.scales + 3 * slot, scales + 3 * i), put<3>(out.colors + 3 * slot, x + COLOR);
      if (actor < 0) {
        put<3>(out.means + 3 * slot, x), put<4>(out.quats + 4 * slot, q);
        out.opacities[slot] = opacity;
        continue;
      }
      const Pose& pose = in.poses[frames.at[f] * in.actors + actor];
      const float *R = pose.turn, *p = pose.quat;
      float* mean = out.means + 3 * slot;
      for (int k = 0; k < 3; k++) mean[k] = R[3 * k] * x[0] + R[3 * k + 1] * x[1] + R[3 * k + 2] * x[2] + pose.shift[k];
      float* quat = out.quats + 4 * slot;
      quat[0] = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3];
      quat[1] = p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2];
      quat[2] = p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1];
      quat[3] = p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0];
      out.opacities[slot] = pose.present != 0 ? opacity : absent;
    }
  }
}

// by_splats: the gradients of the splats; scales and slopes are what pose_block wrote.
static void gradient_of_one(const Gaussians& in, const Frames& frames, int64_t i, const float* scales, float slope,
                            const Splats& by_splats, float* out) {
  int64_t slot = in.slot[i];
  const int actor = in.actor[i];
  const float *scale = scales + 3 * slot, unit = in.unit_m[i];
  float sum[ATTRIBUTES] = {};
  for (int64_t f = 0; f < (actor < 0 ? 1 : frames.count); f++, slot += in.moving) {
    const float *m = by_splats.means + 3 * slot, *q = by_splats.quats + 4 * slot;
    for (int k = 0; k < 3; k++) sum[SCALE + k] += by_splats.scales[3 * slot + k], sum[COLOR + k] += by_splats.colors[3 * slot + k];
    if (actor < 0) {
      put<3>(sum + MEAN, m), put<4>(sum + QUAT, q);
      sum[OPACITY] = by_splats.opacities[slot];
      continue;
    }
    const Pose& pose = in.poses[frames.at[f] * in.actors + actor];
    const float *R = pose.turn, *p = pose.quat;
    for (int k = 0; k < 3; k++) sum[MEAN + k] += R[k] * m[0] + R[3 + k] * m[1] + R[6 + k] * m[2];
    // The conjugate of the actor's quaternion times the gradient.
    sum[QUAT] += p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3];
    sum[QUAT + 1] += p[0] * q[1] - p[1] * q[0] - p[2] * q[3] + p[3] * q[2];
    sum[QUAT + 2] += p[0] * q[2] + p[1] * q[3] - p[2] * q[0] - p[3] * q[1];
    sum[QUAT + 3] += p[0] * q[3] - p[1] * q[2] + p[2] * q[1] - p[3] * q[0];
    if (pose.present != 0) sum[OPACITY] += by_splats.opacities[slot];
  }
  // A scale at its limit does not grow with its logarithm; the comparison leaves NaN without a gradient, too.
  const float limit = exponential(LARGEST_LOG_SCALE);
  for (int k = 0; k < 3; k++) sum[MEAN + k] *= unit, sum[SCALE + k] *= scale[k] < limit ? scale[k] : 0.f;
  sum[OPACITY] *= slope;
  put<ATTRIBUTES>(out, sum);
}

extern "C" {

// offsets [N, 14]. Writes the splats, and slopes [N]: the derivatives of opacity by its logit.
int genre_pose(const Gaussians* in, const Frames* frames, const float* offsets, int threads, const Splats* out, float* slopes) {
  return guarded([&] {
    each_block(in->count, threads, [&](int64_t first, int count) { pose_block(*in, *frames, offsets, first, count, *out, slopes); });
  });
}

// Writes by_offsets [N, 14].
int genre_pose_gradient(const Gaussians* in, const Frames* frames, const float* scales, const float* slopes,
                        const Splats* by_splats, int threads, float* by_offsets) {
  return guarded([&] {
    each_block(in->count, threads, [&](int64_t first, int count) {
      for (int64_t i = first; i < first + count; i++)
        gradient_of_one(*in, *frames, i, scales, slopes[i], *by_splats, by_offsets + ATTRIBUTES * i);
    });
  });
}

// Sums what the splats of each Gaussian show of a residual image, [N, IMAGE_RESIDUALS].
int genre_pose_residuals(const Gaussians* in, int64_t frames, const float* by_splats, int threads, float* out) {
  return guarded([&] {
    each_block(in->count, threads, [&](int64_t first, int count) {
      for (int64_t i = first; i < first + count; i++) {
        float sum[IMAGE_RESIDUALS] = {};
        int64_t slot = in->slot[i];
        for (int64_t f = 0; f < (in->actor[i] < 0 ? 1 : frames); f++, slot += in->moving)
          for (int k = 0; k < IMAGE_RESIDUALS; k++) sum[k] += by_splats[IMAGE_RESIDUALS * slot + k];
        put<IMAGE_RESIDUALS>(out + IMAGE_RESIDUALS * i, sum);
      }
    });
  });
}

// depth / alpha, 0 where alpha is.
int genre_expected_depth(int64_t pixels, const float* __restrict alpha, const float* __restrict depth, float* __restrict out) {
  return guarded([&] {
    for (int64_t i = 0; i < pixels; i++) out[i] = alpha[i] > 0 ? depth[i] / alpha[i] : 0.f;
  });
}

// In: the expected depth and the gradient by it. Out, in their place: the gradients by alpha and by depth.
int genre_expected_depth_gradient(int64_t pixels, const float* __restrict alpha, float* __restrict expected, float* __restrict gradient) {
  return guarded([&] {
    for (int64_t i = 0; i < pixels; i++) {
      const float by_depth = alpha[i] > 0 ? gradient[i] / alpha[i] : 0.f;
      expected[i] *= -by_depth, gradient[i] = by_depth;
    }
  });
}

}  // extern "C"
