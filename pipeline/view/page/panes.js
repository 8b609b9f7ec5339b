"use strict";
// Pictures of pixels, colour bars and plots, on canvases.

// A map's values as RGBA: `range` is what the first and the last colour stand for.
function colored(values, range, lut) {
  const [low, high] = range;
  const rgba = new Uint8ClampedArray(4 * values.length);
  for (let i = 0; i < values.length; i++) {
    if (!Number.isFinite(values[i])) continue;
    const place = Math.round((255 * (values[i] - low)) / (high - low || 1));
    const color = 3 * Math.min(255, Math.max(0, place));
    rgba[4 * i] = lut[color];
    rgba[4 * i + 1] = lut[color + 1];
    rgba[4 * i + 2] = lut[color + 2];
    rgba[4 * i + 3] = 255;
  }
  return rgba;
}

function opaque(rgb) {
  const rgba = new Uint8ClampedArray((rgb.length / 3) * 4);
  for (let i = 0, j = 0; i < rgb.length; i += 3, j += 4) {
    rgba[j] = rgb[i];
    rgba[j + 1] = rgb[i + 1];
    rgba[j + 2] = rgb[i + 2];
    rgba[j + 3] = 255;
  }
  return rgba;
}

// A pane of pixels with marks on it. Places are px of the whole frame, whatever is shown of it.
class PixelPane {
  constructor(canvas) {
    this.canvas = canvas;
    this.image = null;
    this.drag = null;
    this.onDrag = () => {};
    const place = (event) => {
      const box = canvas.getBoundingClientRect();
      const [width, height] = this.size;
      return [
        Math.min(width - 1, Math.max(0, Math.floor(((event.clientX - box.left) / box.width) * width))),
        Math.min(height - 1, Math.max(0, Math.floor(((event.clientY - box.top) / box.height) * height))),
      ];
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (!this.image) return;
      canvas.setPointerCapture(event.pointerId);
      this.drag = place(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (this.drag) this.onDrag(this.drag, place(event), false);
    });
    canvas.addEventListener("pointerup", (event) => {
      if (this.drag) this.onDrag(this.drag, place(event), true);
      this.drag = null;
    });
  }

  // RGBA of (height, width) px, which stand for `size` px of the frame.
  show(rgba, width, height, size) {
    this.size = size;
    this.image = new ImageData(rgba, width, height);
  }

  // Draw the pixels and what is marked: a list of { kind, a, b } in px of the frame.
  draw(marks) {
    if (!this.image) return;
    const { width, height } = this.image;
    this.canvas.width = width;
    this.canvas.height = height;
    const context = this.canvas.getContext("2d");
    context.putImageData(this.image, 0, 0);
    context.scale(width / this.size[0], height / this.size[1]);
    const unit = this.size[0] / Math.max(1, this.canvas.clientWidth);
    context.lineWidth = 2 * unit;
    for (const { kind, a, b, text } of marks) {
      context.strokeStyle = context.fillStyle = "#fff";
      context.shadowColor = "#000";
      context.shadowBlur = 4;
      context.beginPath();
      const [x, y] = [a[0] + 0.5, a[1] + 0.5];
      if (kind === "point") context.arc(x, y, 5 * unit, 0, 2 * Math.PI);
      if (kind === "section") context.moveTo(x, y), context.lineTo(b[0] + 0.5, b[1] + 0.5);
      if (kind === "ball") context.arc(x, y, Math.hypot(b[0] - a[0], b[1] - a[1]), 0, 2 * Math.PI);
      if (kind === "crop") context.rect(x, y, b[0] - a[0], b[1] - a[1]);
      context.stroke();
      if (text) {
        context.font = `${13 * unit}px sans-serif`;
        context.fillText(text, x + 8 * unit, y - 8 * unit);
      }
    }
  }
}

// Ticks at round values.
function ticks(low, high, most) {
  const raw = (high - low) / most || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((each) => each >= raw);
  const found = [];
  for (let value = Math.ceil(low / step) * step; value <= high + 1e-9 * step; value += step) found.push(value);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return found.map((value) => [value, value.toFixed(Math.min(digits, 9))]);
}

function sharp(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  context.clearRect(0, 0, width, height);
  context.font = "11px sans-serif";
  context.fillStyle = context.strokeStyle = getComputedStyle(canvas).color;
  return [context, width, height];
}

// The bar that explains a map's colours.
function drawBar(canvas, range, lut, label) {
  const [context, width, height] = sharp(canvas);
  const [top, bottom] = [22, height - 10];
  for (let y = top; y < bottom; y++) {
    const color = 3 * Math.round((255 * (bottom - 1 - y)) / (bottom - 1 - top));
    context.fillStyle = `rgb(${lut[color]},${lut[color + 1]},${lut[color + 2]})`;
    context.fillRect(4, y, 14, 1);
  }
  context.fillStyle = getComputedStyle(canvas).color;
  context.fillText(label, 4, 12, width - 6);
  if (!range.every(Number.isFinite)) return;
  for (const [value, text] of ticks(range[0], range[1], 6)) {
    const y = bottom - ((value - range[0]) / (range[1] - range[0] || 1)) * (bottom - top);
    context.fillText(text, 23, y + 4, width - 24);
  }
}

// Curves [{ x, y, color }], with gaps where y is NaN.
function drawPlot(canvas, curves, across, up) {
  const [context, width, height] = sharp(canvas);
  const all = (axis) => percentiles(curves.flatMap((curve) => Array.from(curve[axis])), [0, 1]);
  const [[left, right], [low, high]] = [all("x"), all("y")];
  if (![left, right, low, high].every(Number.isFinite)) return;
  const ink = context.fillStyle;
  const box = { left: 58, right: width - 12, top: 18, bottom: height - 32 };
  const x = (value) => box.left + ((value - left) / (right - left || 1)) * (box.right - box.left);
  const y = (value) => box.bottom - ((value - low) / (high - low || 1)) * (box.bottom - box.top);
  context.globalAlpha = 0.35;
  context.strokeRect(box.left, box.top, box.right - box.left, box.bottom - box.top);
  context.globalAlpha = 1;
  for (const [value, text] of ticks(left, right, 6)) context.fillText(text, x(value) - 8, box.bottom + 13);
  for (const [value, text] of ticks(low, high, 4)) context.fillText(text, 4, y(value) + 4, box.left - 8);
  context.fillText(across, (box.left + box.right) / 2 - 40, height - 4);
  context.fillText(up, 4, 11);
  for (const curve of curves) {
    context.strokeStyle = curve.color ?? ink;
    context.beginPath();
    let drawn = false;
    for (let i = 0; i < curve.x.length; i++) {
      const known = Number.isFinite(curve.y[i]);
      if (known) context[drawn ? "lineTo" : "moveTo"](x(curve.x[i]), y(curve.y[i]));
      drawn = known;
    }
    context.stroke();
  }
}
