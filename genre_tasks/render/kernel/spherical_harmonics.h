// The colours that views see of Gaussians with spherical harmonics, forward and backward; scene/spherical_harmonics.py is the
// oracle. Each Gaussian adds up its views in their order: every result has the same bits at any number of threads.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "../../compiled/runtime.h"

struct ShGaussians {
  int64_t count, sh_count;                     // N, K
  const float *means, *colors, *coefficients;  // [N, 3], [N, 3], [N, K, 3], in each Gaussian's own coordinate frame
  const int32_t* coordinate_frame;             // [N]: which one that is; 0 is the chunk's, the others are the actors' boxes
  const int32_t* slot;                         // [N]: index among the splats of the first log frame
  int64_t views, coordinate_frames, splats;    // V, 1 + A, splats of all log frames
  const float* camera_centers;                 // [V, 1 + A, 3] the camera's centre in each coordinate frame
  const int64_t* frame_offset;                 // [V]: a moving Gaussian's splat comes so many after its slot
};

// Y[k] of the unit direction, and with GRADIENT its derivatives by x, y and z. Signs and order of 3DGS.
template <bool GRADIENT>
static inline void evaluate_sh_basis(int64_t count, float x, float y, float z, float* Y, float (*D)[3]) {
  auto put = [&](int k, float value, float dx, float dy, float dz) {
    Y[k] = value;
    if (GRADIENT) D[k][0] = dx, D[k][1] = dy, D[k][2] = dz;
  };
  const float c = 0.4886025119029199f;
  put(0, -c * y, 0, -c, 0), put(1, c * z, 0, 0, c), put(2, -c * x, -c, 0, 0);
  if (count <= 3) return;
  const float a = 1.0925484305920792f, b = 0.31539156525252005f, e = 0.5462742152960396f;
  put(3, a * x * y, a * y, a * x, 0), put(4, -a * y * z, 0, -a * z, -a * y);
  put(5, b * (2 * z * z - x * x - y * y), -2 * b * x, -2 * b * y, 4 * b * z);
  put(6, -a * x * z, -a * z, 0, -a * x), put(7, e * (x * x - y * y), 2 * e * x, -2 * e * y, 0);
}

// Calls f(view, splat, direction, 1 / distance, whether the distance is clamped) for each view.
template <class F>
static inline void for_each_view_direction(const ShGaussians& g, int64_t i, F f) {
  const float* mean = g.means + 3 * i;
  for (int64_t v = 0; v < g.views; v++) {
    const float* camera_center = g.camera_centers + 3 * (v * g.coordinate_frames + g.coordinate_frame[i]);
    const float x = mean[0] - camera_center[0], y = mean[1] - camera_center[1], z = mean[2] - camera_center[2];
    const float square = x * x + y * y + z * z;
    const bool distance_clamped = !(square >= NEAR_M * NEAR_M);
    const float inverse = 1.f / std::sqrt(distance_clamped ? NEAR_M * NEAR_M : square);
    const float d[3] = {x * inverse, y * inverse, z * inverse};
    f(v, v * g.splats + g.slot[i] + (g.coordinate_frame[i] ? g.frame_offset[v] : 0), d, inverse, distance_clamped);
  }
}

constexpr int MAX_SH_COUNT = 8;

static inline bool is_finite_gaussian(const ShGaussians& g, int64_t i) {
  bool finite = true;
  for (int k = 0; k < 3; k++) finite &= std::isfinite(g.means[3 * i + k]);
  for (int64_t k = 0; k < 3 * g.sh_count; k++) finite &= std::isfinite(g.coefficients[3 * g.sh_count * i + k]);
  return finite;
}

template <class F>
static void parallel_for(int64_t count, int threads, F f) {
  const int team = (int)std::max<int64_t>(1, std::min<int64_t>(threads, count / 512));
  parallel(team, [&](int w) {
    for (int64_t i = count * w / team; i < count * (w + 1) / team; i++) f(i);
  });
}

// out [V, splats, 3]; what a view does not show is 0.
static void sh_colors_forward(const ShGaussians& g, int threads, float* out) {
  std::fill(out, out + 3 * g.views * g.splats, 0.f);
  parallel_for(g.count, threads, [&](int64_t i) {
    const float *coefficients = g.coefficients + 3 * g.sh_count * i, *color = g.colors + 3 * i;
    const bool finite = is_finite_gaussian(g, i);
    for_each_view_direction(g, i, [&](int64_t, int64_t splat, const float* d, float, bool) {
      float Y[MAX_SH_COUNT], sum[3] = {color[0], color[1], color[2]};
      evaluate_sh_basis<false>(g.sh_count, d[0], d[1], d[2], Y, nullptr);
      for (int64_t k = 0; k < g.sh_count; k++)
        for (int c = 0; c < 3; c++) sum[c] += Y[k] * coefficients[3 * k + c];
      for (int c = 0; c < 3; c++) out[3 * splat + c] = !finite ? NAN : sum[c] < 0 ? 0.f : sum[c];
    });
  });
}

// view_colors [V, splats, 3] is what sh_colors_forward wrote.
static void sh_colors_backward(const ShGaussians& g, int threads, const float* view_colors, const float* grad_view_colors,
                               float* grad_means, float* grad_colors, float* grad_coefficients) {
  parallel_for(g.count, threads, [&](int64_t i) {
    const int64_t K = g.sh_count;
    const float *coefficients = g.coefficients + 3 * K * i, *color = g.colors + 3 * i;
    float *grad_mean = grad_means + 3 * i, *grad_color = grad_colors + 3 * i, *grad_coefficient = grad_coefficients + 3 * K * i;
    std::fill(grad_mean, grad_mean + 3, 0.f), std::fill(grad_color, grad_color + 3, 0.f);
    std::fill(grad_coefficient, grad_coefficient + 3 * K, 0.f);
    if (!is_finite_gaussian(g, i)) return;
    for_each_view_direction(g, i, [&](int64_t, int64_t splat, const float* d, float inverse, bool distance_clamped) {
      float v[3], Y[MAX_SH_COUNT], D[MAX_SH_COUNT][3], grad_direction[3] = {};
      for (int c = 0; c < 3; c++) v[c] = view_colors[3 * splat + c] >= 0 ? grad_view_colors[3 * splat + c] : 0.f;
      if (v[0] == 0 && v[1] == 0 && v[2] == 0) return;
      evaluate_sh_basis<true>(K, d[0], d[1], d[2], Y, D);
      // A colour of 0 was clamped, which has no gradient, or is 0 by itself, such as that of a black point.
      for (int c = 0; c < 3; c++) {
        if (view_colors[3 * splat + c] > 0) continue;
        float sum = color[c];
        for (int64_t k = 0; k < K; k++) sum += Y[k] * coefficients[3 * k + c];
        if (sum < 0) v[c] = 0;
      }
      for (int c = 0; c < 3; c++) grad_color[c] += v[c];
      for (int64_t k = 0; k < K; k++) {
        float grad_Y = 0;
        for (int c = 0; c < 3; c++) grad_coefficient[3 * k + c] += Y[k] * v[c], grad_Y += coefficients[3 * k + c] * v[c];
        for (int j = 0; j < 3; j++) grad_direction[j] += grad_Y * D[k][j];
      }
      // The direction's length has no gradient, unless the distance is clamped: then the direction is not normalised.
      const float along =
          distance_clamped ? 0.f : d[0] * grad_direction[0] + d[1] * grad_direction[1] + d[2] * grad_direction[2];
      for (int j = 0; j < 3; j++) grad_mean[j] += (grad_direction[j] - along * d[j]) * inverse;
    });
  });
}
