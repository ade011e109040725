"use strict";

// Orthographic pictures of a triangle mesh on a 2-D canvas: faces painted from back to front, then lines. A mesh of
// the benchmark has a few hundred faces, for which this is fast enough on a phone, and it needs no graphics card.

const STOPS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]; // viridis

function viridis(share) {
  const place = Math.min(Math.max(share, 0), 1) * (STOPS.length - 1);
  const from = Math.min(Math.floor(place), STOPS.length - 2);
  return STOPS[from].map((value, i) => value + (STOPS[from + 1][i] - value) * (place - from));
}

class Viewer {
  // onchange is called when the picture must be drawn again.
  constructor(canvas, onchange) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.onchange = onchange;
    this.pointers = new Map();
    this.first = { azimuth: 0, elevation: 0, zoom: 1, x: 0, y: 0 };
    this.view = { ...this.first };
    this.listen();
    new ResizeObserver(() => onchange()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => onchange());
  }

  // Look at a box; angles in degrees as in matplotlib. A flat scene is seen from above.
  aim(lower, upper, azimuth, elevation, flat) {
    [this.lower, this.upper, this.flat] = [lower, upper, flat];
    this.centre = lower.map((value, i) => (value + upper[i]) / 2);
    const [a, e] = flat ? [-90, 90] : [azimuth, elevation];
    this.first = { azimuth: (a * Math.PI) / 180, elevation: (e * Math.PI) / 180, zoom: 1, x: 0, y: 0 };
    this.reset();
  }

  reset() {
    this.view = { ...this.first };
    this.onchange();
  }

  zoom(factor) {
    this.view.zoom = Math.min(Math.max(this.view.zoom * factor, 0.2), 40);
    this.onchange();
  }

  // By pixels on the screen: turns, or moves what is flat.
  drag(dx, dy) {
    if (this.flat) {
      this.view.x += dx;
      this.view.y += dy;
    } else {
      this.view.azimuth -= dx * 0.01;
      this.view.elevation = Math.min(Math.max(this.view.elevation + dy * 0.01, -Math.PI / 2), Math.PI / 2);
    }
    this.onchange();
  }

  listen() {
    const { canvas, pointers } = this;
    const spread = () => {
      const [a, b] = [...pointers.values()];
      return Math.hypot(a[0] - b[0], a[1] - b[1]);
    };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const apart = pointers.size === 2 ? spread() : 0;
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      if (pointers.size === 1) this.drag(event.clientX - before[0], event.clientY - before[1]);
      else if (apart) this.zoom(spread() / apart);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
    }
    canvas.addEventListener(
      "wheel",
      (event) => {
        event.preventDefault();
        this.zoom(Math.exp(-event.deltaY * 0.001));
      },
      { passive: false },
    );
    const keys = {
      ArrowLeft: () => this.drag(-12, 0),
      ArrowRight: () => this.drag(12, 0),
      ArrowUp: () => this.drag(0, -12),
      ArrowDown: () => this.drag(0, 12),
      "+": () => this.zoom(1.15),
      "-": () => this.zoom(1 / 1.15),
      0: () => this.reset(),
    };
    canvas.addEventListener("keydown", (event) => {
      if (!(event.key in keys) || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  // The directions to the right, upwards and towards the viewer.
  axes({ azimuth: a, elevation: e }) {
    return [
      [-Math.sin(a), Math.cos(a), 0],
      [-Math.sin(e) * Math.cos(a), -Math.sin(e) * Math.sin(a), Math.cos(e)],
      [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)],
    ];
  }

  // Pixels per unit of length for which the first view fills the canvas.
  fit(width, height) {
    const extent = (axis) => axis.reduce((sum, d, i) => sum + Math.abs(d) * (this.upper[i] - this.lower[i]), 0);
    const [right, up] = this.axes(this.first);
    return 0.88 * Math.min(width / extent(right), height / extent(up));
  }

  // Fit the canvas to its place on the page, wipe it, and set up the projection.
  begin() {
    const { canvas, pen } = this;
    const { zoom, x, y } = this.view;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const dense = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * dense)) canvas.width = Math.round(width * dense);
    if (canvas.height !== Math.round(height * dense)) canvas.height = Math.round(height * dense);
    pen.setTransform(dense, 0, 0, dense, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.lineJoin = "round";
    this.scale = zoom * this.fit(width, height);
    this.middle = [width / 2 + x, height / 2 + y];
    [this.right, this.up, this.towards] = this.axes(this.view);
    this.style = getComputedStyle(canvas);
  }

  ink(name) {
    return this.style.getPropertyValue(name).trim();
  }

  // Points [x, y, z, x, ...] on the canvas: [right, down, towards the viewer, ...].
  project(points) {
    const result = new Float32Array(points.length);
    const { centre, scale, middle, right, up, towards } = this;
    for (let i = 0; i < points.length; i += 3) {
      const [x, y, z] = [points[i] - centre[0], points[i + 1] - centre[1], points[i + 2] - centre[2]];
      result[i] = middle[0] + scale * (right[0] * x + right[1] * y + right[2] * z);
      result[i + 1] = middle[1] - scale * (up[0] * x + up[1] * y + up[2] * z);
      result[i + 2] = scale * (towards[0] * x + towards[1] * y + towards[2] * z);
    }
    return result;
  }

  // Lines through points, each a list of node numbers, as one stroke; with a halo they are seen on any colour.
  lines(points, paths, colour, width, halo = null) {
    const { pen } = this;
    pen.beginPath();
    for (const path of paths) {
      path.forEach((node, i) => pen[i ? "lineTo" : "moveTo"](points[3 * node], points[3 * node + 1]));
    }
    if (halo) {
      pen.strokeStyle = halo;
      pen.lineWidth = 2.5 * width;
      pen.stroke();
    }
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.stroke();
  }

  dots(points, colour, radius) {
    this.pen.fillStyle = colour;
    for (let i = 0; i < points.length; i += 3) {
      this.pen.beginPath();
      this.pen.arc(points[i], points[i + 1], radius, 0, 2 * Math.PI);
      this.pen.fill();
    }
  }

  // Twice the area of a triangle on the screen, positive where its front is seen.
  area(points, [a, b, c]) {
    const [x, y] = [points[3 * a], points[3 * a + 1]];
    return (points[3 * c] - x) * (points[3 * b + 1] - y) - (points[3 * b] - x) * (points[3 * c + 1] - y);
  }

  // Filled triangles; colour(corners) gives red, green and blue. What is seen edge-on is darker.
  faces(points, faces, colour) {
    const { pen } = this;
    const depth = ([a, b, c]) => points[3 * a + 2] + points[3 * b + 2] + points[3 * c + 2];
    for (const face of [...faces].sort((one, other) => depth(one) - depth(other))) {
      const [a, b, c] = face.map((node) => points.subarray(3 * node, 3 * node + 3));
      const u = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
      const v = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
      const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      const light = 0.72 + (0.28 * Math.abs(normal[2])) / (Math.hypot(...normal) || 1);
      pen.beginPath();
      pen.moveTo(a[0], a[1]);
      pen.lineTo(b[0], b[1]);
      pen.lineTo(c[0], c[1]);
      pen.closePath();
      pen.fillStyle = pen.strokeStyle = `rgb(${colour(face).map((value) => Math.round(value * light)).join(" ")})`;
      pen.fill();
      pen.lineWidth = 0.6; // closes the seams between neighbours
      pen.stroke();
    }
  }
}
