// A camera, and where it sees Gaussians, sixteen at a time: lens distortion and rolling shutter, forward and backward. What a
// view does not have is compiled out. reference_camera.py is the same in plain torch, written for reading.
#pragma once
#include <type_traits>

#include "simd.h"

struct Camera {
  float R[9], t[3], fx, fy, cx, cy;
  int width, height;
  float right, left, bottom, top;  // limits of x/z and y/z at which the projection is linearised
  bool has_distortion, has_rolling_shutter, antialiased;
  float k1, k2, p1, p2, k3, fold_radius2;
  float readout, velocity[3], turn[3];  // s; m/s and rad/s in camera axes
};

// pose: row-major 4x4, chunk to camera. lens: fx, fy, cx, cy. distortion, or null: k1, k2, p1, p2, k3, square of the fold
// radius, limits left, right, top, bottom. shutter, or null: readout, velocity, turn.
static Camera make_camera(const float* pose, const float* lens, const float* distortion, const float* shutter,
                          bool antialiased, int width, int height) {
  Camera c{};
  c.antialiased = antialiased;
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) c.R[3 * i + j] = pose[4 * i + j];
    c.t[i] = pose[4 * i + 3];
  }
  c.fx = lens[0], c.fy = lens[1], c.cx = lens[2], c.cy = lens[3], c.width = width, c.height = height;
  float mx = JACOBIAN_MARGIN * .5f * width / c.fx, my = JACOBIAN_MARGIN * .5f * height / c.fy;
  c.right = (width - c.cx) / c.fx + mx, c.left = c.cx / c.fx + mx;
  c.bottom = (height - c.cy) / c.fy + my, c.top = c.cy / c.fy + my;
  for (int k = 0; distortion && k < 5; k++) c.has_distortion |= distortion[k] != 0.f;
  if (c.has_distortion) {
    c.k1 = distortion[0], c.k2 = distortion[1], c.p1 = distortion[2], c.p2 = distortion[3], c.k3 = distortion[4];
    c.fold_radius2 = distortion[5];
    c.left = distortion[6], c.right = distortion[7], c.top = distortion[8], c.bottom = distortion[9];
  }
  c.has_rolling_shutter = shutter && shutter[0] != 0.f;
  if (c.has_rolling_shutter) {
    c.readout = shutter[0];
    for (int k = 0; k < 3; k++) c.velocity[k] = shutter[1 + k], c.turn[k] = shutter[4 + k];
  }
  return c;
}

// Calls f(has_rolling_shutter, has_distortion, antialiased) with compile-time constants: one copy of the code for each camera
// that occurs.
template <class F>
static void specialise_for(const Camera& c, F f) {
  const std::true_type yes;
  const std::false_type no;
  auto choose = [&](auto antialiased) {
    if (c.has_rolling_shutter) c.has_distortion ? f(yes, yes, antialiased) : f(yes, no, antialiased);
    else c.has_distortion ? f(no, yes, antialiased) : f(no, no, antialiased);
  };
  c.antialiased ? choose(yes) : choose(no);
}

// Normalised image coordinates x, y after the distortion, and its slopes: xx = dx/du, xy = dx/dv = dy/du, yy = dy/dv. The two
// mixed ones are equal, since the distortion is the gradient of a potential.
struct DistortedPoint {
  Lanes x, y, xx, xy, yy;
  INLINE_MEMBER DistortedPoint(const Camera& c, const Lanes& u, const Lanes& v) {
    const Lanes r2 = u * u + v * v, radial = 1.f + r2 * (c.k1 + r2 * (c.k2 + r2 * c.k3));
    const Lanes slope = c.k1 + r2 * (2.f * c.k2 + r2 * (3.f * c.k3)), cross = 2.f * u * v;
    x = u * radial + c.p1 * cross + c.p2 * (r2 + 2.f * u * u), y = v * radial + c.p1 * (r2 + 2.f * v * v) + c.p2 * cross;
    xx = radial + 2.f * u * u * slope + 2.f * c.p1 * v + 6.f * c.p2 * u;
    xy = cross * slope + 2.f * c.p1 * u + 2.f * c.p2 * v;
    yy = radial + 2.f * v * v * slope + 6.f * c.p1 * v + 2.f * c.p2 * u;
  }
  // Adds to (vu, vv) the gradient by the coordinates of a function whose gradient by the slopes is (vxx, vxy, vyy).
  static INLINE_MEMBER void slopes_backward(const Camera& c, const Lanes& u, const Lanes& v, const Lanes& vxx, const Lanes& vxy,
                                            const Lanes& vyy, Lanes& vu, Lanes& vv) {
    const Lanes r2 = u * u + v * v, slope = 2.f * (c.k1 + r2 * (2.f * c.k2 + r2 * (3.f * c.k3)));
    const Lanes curvature = 8.f * c.k2 + 24.f * c.k3 * r2;
    const Lanes xxx = u * (3.f * slope + u * u * curvature) + 6.f * c.p2, xxy = v * (slope + u * u * curvature) + 2.f * c.p1;
    const Lanes xyy = u * (slope + v * v * curvature) + 2.f * c.p2, yyy = v * (3.f * slope + v * v * curvature) + 6.f * c.p1;
    vu += vxx * xxx + vxy * xxy + vyy * xyy, vv += vxx * xxy + vxy * xyy + vyy * yyy;
  }
};

// Camera coordinates of Gaussians at the time of the pose. For a global shutter they are projected from there.
struct PosedPosition {
  Lanes position[3];
  template <class Gaussian>
  INLINE_MEMBER PosedPosition(const Camera& c, const Gaussian& g) {
    const Lanes(&m)[3] = g.mean;
    for (int i = 0; i < 3; i++) position[i] = c.R[3 * i] * m[0] + c.R[3 * i + 1] * m[1] + c.R[3 * i + 2] * m[2] + c.t[i];
  }
  INLINE_MEMBER void shear(Lanes (&)[6]) const {}
  INLINE_MEMBER void shear_backward(const Lanes (&)[3], Lanes (&)[6], Lanes (&)[2]) const {}
  INLINE_MEMBER void backward(const Camera&, const Lanes (&)[2], Lanes (&)[3]) const {}
  INLINE_MEMBER Mask ahead() const { return position[2] >= NEAR_M; }
  INLINE_MEMBER Mask unfolded(const Camera& c) const { return within(c, position); }
  static INLINE_MEMBER Mask within(const Camera& c, const Lanes (&p)[3]) {
    const Lanes rz = 1.f / p[2], u = p[0] * rz, v = p[1] * rz;
    return u * u + v * v <= c.fold_radius2;
  }
};

// Camera coordinates of Gaussians when their rows are exposed by a rolling shutter, and how their footprints are sheared as
// lower rows come later. Shutter in types.py has the formulas.
template <bool DISTORTION>
struct ExposedPosition {
  PosedPosition posed;
  Lanes position[3], motion[3], rz, u, v, u_rate, v_rate, time;
  Lanes column_rate, row_rate;  // px/s
  Lanes rate, delay_per_row;    // 1 - T row_rate / H, at least SHUTTER_MIN_RATE; s a row, 0 where the time is limited
  Mask rate_limited, time_limited;

  template <class Gaussian>
  INLINE_MEMBER ExposedPosition(const Camera& c, const Gaussian& g) : posed(c, g) {
    const Lanes(&p)[3] = posed.position, (&w)[3] = g.velocity;
    for (int i = 0, j = 1, k = 2; i < 3; i++, j = (j + 1) % 3, k = (k + 1) % 3)
      motion[i] = c.R[3 * i] * w[0] + c.R[3 * i + 1] * w[1] + c.R[3 * i + 2] * w[2] - c.velocity[i] -
                  (c.turn[j] * p[k] - c.turn[k] * p[j]);
    rz = 1.f / p[2], u = p[0] * rz, v = p[1] * rz;
    u_rate = (motion[0] - u * motion[2]) * rz, v_rate = (motion[1] - v * motion[2]) * rz;
    Lanes row;
    if constexpr (DISTORTION) {
      const DistortedPoint distorted(c, u, v);
      row = c.fy * distorted.y + c.cy, row_rate = c.fy * (distorted.xy * u_rate + distorted.yy * v_rate);
      column_rate = c.fx * (distorted.xx * u_rate + distorted.xy * v_rate);
    } else {
      row = c.fy * v + c.cy, row_rate = c.fy * v_rate, column_rate = c.fx * u_rate;
    }
    const float per_row = c.readout / c.height, half = .5f * c.readout;
    const Lanes unclamped_rate = 1.f - per_row * row_rate;
    rate_limited = unclamped_rate < SHUTTER_MIN_RATE, rate = max(unclamped_rate, broadcast(SHUTTER_MIN_RATE));
    const Lanes row_time = (per_row * row - half) / rate;
    time_limited = (row_time > half) | (row_time < -half), time = clamp(row_time, broadcast(-half), broadcast(half));
    delay_per_row = keep(per_row / rate, ~time_limited);
    for (int i = 0; i < 3; i++) position[i] = p[i] + time * motion[i];
  }
  INLINE_MEMBER Mask ahead() const { return posed.ahead() & (position[2] >= NEAR_M); }
  INLINE_MEMBER Mask unfolded(const Camera& c) const { return posed.unfolded(c) & PosedPosition::within(c, position); }

  // W's rows are the slopes of the pixel's column and row by chunk axes. What lies a row lower is seen delay_per_row later.
  INLINE_MEMBER void shear(Lanes (&W)[6]) const {
    for (int k = 0; k < 3; k++)
      W[k] += delay_per_row * column_rate * W[3 + k], W[3 + k] += delay_per_row * row_rate * W[3 + k];
  }
  // Turns the gradient by the sheared W into those by W, whose second row was `row`, and by the shear's two entries.
  INLINE_MEMBER void shear_backward(const Lanes (&row)[3], Lanes (&vW)[6], Lanes (&grad_shear)[2]) const {
    grad_shear[0] = grad_shear[1] = Lanes{};
    for (int k = 0; k < 3; k++) {
      grad_shear[0] += vW[k] * row[k], grad_shear[1] += vW[3 + k] * row[k];
      vW[3 + k] += delay_per_row * (column_rate * vW[k] + row_rate * vW[3 + k]);
    }
  }
  // Turns the gradient g by `position` into that by the camera coordinates at the pose's time.
  INLINE_MEMBER void backward(const Camera& c, const Lanes (&grad_shear)[2], Lanes (&g)[3]) const {
    const float per_row = c.readout / c.height;
    const Lanes grad_row_time = keep((g[0] * motion[0] + g[1] * motion[1] + g[2] * motion[2]) / rate, ~time_limited);
    const Lanes grad_delay = grad_shear[0] * column_rate + grad_shear[1] * row_rate;
    const Lanes grad_row = per_row * c.fy * grad_row_time, grad_column_rate = c.fx * delay_per_row * grad_shear[0];
    const Lanes grad_row_rate =
        c.fy * (delay_per_row * grad_shear[1] +
                per_row * keep(time * grad_row_time + delay_per_row / rate * grad_delay, ~rate_limited));
    Lanes vu{}, vv{}, vu_rate{}, vv_rate{};
    if constexpr (DISTORTION) {
      const DistortedPoint distorted(c, u, v);
      vu = grad_row * distorted.xy, vv = grad_row * distorted.yy;
      vu_rate = grad_column_rate * distorted.xx + grad_row_rate * distorted.xy;
      vv_rate = grad_column_rate * distorted.xy + grad_row_rate * distorted.yy;
      DistortedPoint::slopes_backward(c, u, v, grad_column_rate * u_rate, grad_column_rate * v_rate + grad_row_rate * u_rate,
                                      grad_row_rate * v_rate, vu, vv);
    } else {
      vv = grad_row, vu_rate = grad_column_rate, vv_rate = grad_row_rate;
    }
    vu_rate = vu_rate * rz, vv_rate = vv_rate * rz;
    vu = (vu - vu_rate * motion[2]) * rz, vv = (vv - vv_rate * motion[2]) * rz;
    const Lanes d[3] = {time * g[0] + vu_rate, time * g[1] + vv_rate, time * g[2] - vu_rate * u - vv_rate * v};
    g[0] += vu, g[1] += vv;
    g[2] = g[2] - vu * u - vv * v - vu_rate * u_rate - vv_rate * v_rate;
    for (int i = 0, j = 1, k = 2; i < 3; i++, j = (j + 1) % 3, k = (k + 1) % 3) g[i] += c.turn[j] * d[k] - c.turn[k] * d[j];
  }
};
