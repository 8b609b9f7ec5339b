"use strict";
// Three panes that belong together: the camera's picture, a map and the surface; a time bar, and measuring tools.

// While a film plays, or the time bar moves, no more pixels of a frame than this are asked for.
const MOST_PIXELS = 80000;
// The time bar rests when it has not moved for this long, ms; then a frame is shown whole.
const REST_MS = 250;
// A result that is still being written is asked how long it is this often, ms.
const GROWTH_MS = 2000;
// The values beyond these shares are mostly wrong, and have the first or the last colour.
const SHARES = [0.01, 0.99];
const CLAY = "clay";

const element = (id) => document.getElementById(id);

class Viewer {
  constructor(source) {
    this.source = source;
    this.frame = null;
    this.marks = [];
    this.ranges = {};
    this.playing = null;
    this.wanted = null;
    this.loading = false;
    this.picture = new PixelPane(document.querySelector("#picture canvas"));
    this.map = new PixelPane(document.querySelector("#map canvas"));
    this.surface = new Surface(document.querySelector("#surface canvas"));
    for (const pane of [this.picture, this.map]) {
      pane.onDrag = (a, b, done) => this.dragged(a, b, done);
    }
  }

  async start() {
    while (!this.about) {
      try {
        this.about = await this.source.about();
      } catch (error) {
        this.say(error.message);
        await new Promise((resolve) => setTimeout(resolve, GROWTH_MS));
      }
    }
    this.say("");
    this.lut = Uint8Array.from(atob(this.about.colors), (letter) => letter.charCodeAt(0));
    document.title = document.querySelector("h1").textContent = this.about.title;
    document.querySelector("main").classList.toggle("alone", !this.about.size);
    for (const part of ["back", "forward", "place", "speed"]) element(part).disabled = this.about.live;
    element("clipped").parentElement.hidden = !this.about.camera;
    element("clipped").checked = this.about.live;
    document.querySelector("#picture span").textContent = this.about.camera ? "Camera" : "Texture";
    this.listFields();
    this.listen();
    if (this.about.live) this.follow();
    else {
      this.extend();
      this.show(0);
      if (this.about.growing) setInterval(() => this.grow(), GROWTH_MS);
    }
  }

  // Fill the lists of what a map and colours show.
  listFields() {
    const names = Object.keys(this.about.maps);
    const [map, color] = [element("field"), element("color")];
    const [shown, coloring] = [map.value, color.value];
    const shape = this.shape ? ["deviation"] : [];
    map.replaceChildren(...[...names, ...shape].map((name) => new Option(this.label(name), name)));
    color.replaceChildren(...[CLAY, ...names, ...shape].map((name) => new Option(this.label(name), name)));
    if ([...names, ...shape].includes(shown)) map.value = shown;
    if ([CLAY, ...names, ...shape].includes(coloring)) color.value = coloring;
  }

  label(name) {
    const unit = this.unit(name);
    return (name === "deviation" ? `off the ${this.shape.kind}` : name) + (unit ? ` (${unit})` : "");
  }

  unit(name) {
    return name === "deviation" ? "mm" : (this.about.maps[name]?.unit ?? "");
  }

  listen() {
    const again = () => this.refresh();
    element("field").addEventListener("change", again);
    element("color").addEventListener("change", again);
    element("style").addEventListener("change", again);
    element("clipped").addEventListener("change", () => this.redraw());
    element("refit").addEventListener("click", () => {
      this.ranges = {};
      this.redraw();
    });
    element("clear").addEventListener("click", () => this.setMarks([]));
    element("save").addEventListener("click", () => this.save());
    element("play").addEventListener("click", () => (this.about.live ? this.hold() : this.play()));
    element("back").addEventListener("click", () => this.show(this.place - 1));
    element("forward").addEventListener("click", () => this.show(this.place + 1));
    element("place").addEventListener("input", (event) => this.scrub(Number(event.target.value)));
    for (const button of document.querySelectorAll("[data-look]")) {
      button.addEventListener("click", () => this.surface.look(button.dataset.look));
    }
    const canvas = this.surface.canvas;
    let down = null;
    canvas.addEventListener("pointerdown", (event) => (down = [event.offsetX, event.offsetY]));
    canvas.addEventListener("pointerup", (event) => {
      const still = down && Math.hypot(event.offsetX - down[0], event.offsetY - down[1]) < 3;
      if (!still || this.tool !== "point" || !this.frame) return;
      const picked = this.surface.pick(event.offsetX, event.offsetY);
      if (picked >= 0) this.setMarks([...this.points, { kind: "point", a: this.pixel(picked), vertex: picked }]);
    });
    new ResizeObserver(() => this.redraw()).observe(document.querySelector("main"));
  }

  get tool() {
    return document.querySelector("[name=tool]:checked").value;
  }

  get points() {
    return this.marks.filter((mark) => mark.kind === "point");
  }

  // Frames.

  get place() {
    return Number(element("place").value);
  }

  // The step at which a frame has few enough pixels to follow.
  get coarse() {
    const [width, height] = this.about.size ?? [0, 0];
    return Math.max(1, Math.ceil(Math.sqrt((width * height) / MOST_PIXELS)));
  }

  get names() {
    const shown = new Set(["points", "sigma", "order", element("field").value, element("color").value]);
    shown.add(this.about.camera ? "picture" : "texture");
    shown.delete(CLAY);
    return [...shown].filter((name) => name in this.about.maps || ["points", "picture"].includes(name));
  }

  // Show a frame whole; or, as long as the bar moves, every few pixels of it.
  show(place, step = 1) {
    place = Math.min(this.about.count - 1, Math.max(0, place));
    element("place").value = place;
    this.wanted = { place, step };
    return this.load();
  }

  scrub(place) {
    clearTimeout(this.resting);
    this.resting = setTimeout(() => this.show(place), REST_MS);
    return this.show(place, this.coarse);
  }

  refresh() {
    return this.about.live ? this.redraw() : this.show(this.place);
  }

  // Fetch what is wanted; of several wishes that come meanwhile the last one counts.
  async load() {
    if (this.loading) return;
    this.loading = true;
    while (this.wanted) {
      const { place, step } = this.wanted;
      this.wanted = null;
      try {
        const frame = this.about.count ? await this.source.frame(place, this.names, step) : null;
        if (!frame) this.say("no frame is there yet");
        else this.take(frame);
      } catch (error) {
        this.say(error.message);
      }
    }
    this.loading = false;
  }

  take(frame) {
    const first = !this.frame;
    this.frame = frame;
    this.say("");
    const time = frame.time_s === null ? "" : `, ${frame.dated ? new Date(1000 * frame.time_s).toISOString() : `${frame.time_s.toFixed(3)} s`}`;
    const part = frame.step > 1 ? `, 1 of ${frame.step}x${frame.step} pixels` : "";
    element("number").textContent = frame.number === null ? "" : `frame ${frame.number}${time}${part}`;
    element("warnings").replaceChildren(
      ...frame.warnings.map((text) => Object.assign(document.createElement("li"), { textContent: text })),
    );
    this.redraw();
    if (first) this.surface.look("front");
    document.body.dataset.shown = frame.number ?? 0;
  }

  say(text) {
    element("status").textContent = text;
  }

  async play() {
    if (this.playing) {
      this.playing = null;
      return;
    }
    const run = (this.playing = {});
    element("play").textContent = "Stop";
    const start = { place: this.place, ms: performance.now() };
    if (start.place === this.about.count - 1) start.place = 0;
    while (this.playing === run) {
      const passed_s = (performance.now() - start.ms) / 1000;
      const place = start.place + Math.floor(passed_s * this.about.rate_hz * Number(element("speed").value));
      if (place >= this.about.count) {
        element("place").value = this.about.count - 1;
        break;
      }
      if (place !== this.place || !this.frame) await this.show(place, this.coarse);
      await new Promise(requestAnimationFrame);
    }
    this.playing = null;
    element("play").textContent = "Play";
    this.show(this.place);
  }

  async grow() {
    try {
      this.about = await this.source.about();
    } catch (error) {
      this.say(error.message);
      return;
    }
    this.extend();
    if (!this.frame) this.show(0);
  }

  extend() {
    document.body.classList.toggle("still", this.about.count < 2);
    element("place").max = Math.max(0, this.about.count - 1);
  }

  // Show live frames as they come.
  async follow() {
    element("play").textContent = "Hold";
    let after = -1;
    const run = (this.playing = {});
    while (this.playing === run) {
      try {
        const frame = await this.source.next(after, this.names, this.coarse);
        if (this.playing !== run) return;
        if (frame) {
          after = frame.number;
          this.take(frame);
          this.say(frame.status);
        } else this.say("no frame has come for some seconds");
      } catch (error) {
        this.say(error.message);
        return;
      }
      await new Promise(requestAnimationFrame);
    }
  }

  hold() {
    if (this.playing) {
      this.playing = null;
      element("play").textContent = "Go on";
    } else this.follow();
  }

  // Values.

  // A map's values, a number for each point.
  values(name) {
    const { arrays } = this.frame;
    if (name === "deviation") return this.everyPoint((point) => this.shape.off(point));
    if (name === "depth" && !arrays.depth && arrays.points) return this.everyPoint((point) => point[2]);
    return arrays[name];
  }

  everyPoint(value) {
    const places = this.frame.arrays.points;
    const found = new Float32Array(places.length / 3);
    for (let i = 0; i < found.length; i++) found[i] = value([places[3 * i], places[3 * i + 1], places[3 * i + 2]]);
    return found;
  }

  // The frame's points; without a calibration pixels and the relative range, scaled to the picture's size.
  places() {
    const { arrays, width, step } = this.frame;
    if (arrays.points) return arrays.points;
    const depth = this.values("depth");
    const [low, high] = percentiles(depth, SHARES);
    const scale = (0.4 * width * step) / (high - low || 1);
    const places = new Float32Array(3 * depth.length);
    for (let i = 0; i < depth.length; i++) {
      places.set([(i % width) * step, Math.floor(i / width) * step, depth[i] * scale], 3 * i);
    }
    return places;
  }

  range(name, values) {
    return (this.ranges[name] ??= percentiles(values, SHARES));
  }

  // A map as RGBA; null: the frame has none.
  rgba(name) {
    const values = this.values(name);
    if (!values) return null;
    return this.about.maps[name]?.kind === "color" ? opaque(values) : colored(values, this.range(name, values), this.lut);
  }

  pixel(i) {
    const { width, step } = this.frame;
    return width ? [(i % width) * step, Math.floor(i / width) * step] : null;
  }

  index(mark) {
    const { width, step } = this.frame;
    return width ? Math.floor(mark.a[1] / step) * width + Math.floor(mark.a[0] / step) : mark.vertex;
  }

  point(mark) {
    const place = 3 * this.index(mark);
    return [...this.frame.arrays.points.subarray(place, place + 3)];
  }

  // All known points for which a pixel is taken, px of the frame.
  pointsWhere(taken) {
    const { arrays, width, step } = this.frame;
    const found = [];
    for (let i = 0; i < arrays.points.length / 3; i++) {
      if (!taken((i % width) * step, Math.floor(i / width) * step)) continue;
      const point = [...arrays.points.subarray(3 * i, 3 * i + 3)];
      if (point.every(Number.isFinite)) found.push(point);
    }
    return found;
  }

  // Marks and what is measured by them.

  dragged(a, b, done) {
    const { tool } = this;
    if (tool === "point") {
      if (done) this.setMarks([...this.points, { kind: "point", a: b }]);
      return;
    }
    const [low, high] = [0, 1].map((side) => [0, 1].map((axis) => [Math.min, Math.max][side](a[axis], b[axis])));
    const mark = tool === "crop" ? { kind: tool, a: low, b: high } : { kind: tool, a, b };
    if (done) this.setMarks([...this.marks.filter(({ kind }) => kind !== tool && !(tool === "ball" && kind === "point")), mark]);
    else this.drawPanes([...this.marks, mark]);
  }

  setMarks(marks) {
    this.marks = marks.filter((mark, i) => mark.kind === "point" || marks.findLastIndex((m) => m.kind === mark.kind) === i);
    this.redraw();
  }

  // What the marks measure in this frame, a line each.
  measure() {
    this.shape = this.box = null;
    const lines = [];
    const { arrays } = this.frame;
    if (!this.marks.length) return lines;
    if (!arrays.points) {
      const depth = this.values("depth");
      for (const [i, mark] of this.points.entries()) {
        lines.push(`${i + 1}: ${number(depth[this.index(mark)])} rad at pixel ${mark.a.join(", ")}`);
      }
      return [...lines, "not metric: give a calibration to measure in mm"];
    }
    const found = this.points.map((mark) => this.point(mark));
    for (const [i, mark] of this.points.entries()) {
      const at = this.index(mark);
      const more = ["sigma", "order"].filter((name) => arrays[name]).map((name) => `, ${name} ${number(arrays[name][at])} ${this.unit(name)}`);
      const known = found[i].every(Number.isFinite);
      lines.push(`${i + 1}: ` + (known ? `${found[i].map(number).join(", ")} mm${more.join("")}` : "nothing is measured here"));
    }
    const known = found.filter((point) => point.every(Number.isFinite));
    if (known.length === 2) lines.push(`distance ${number(distance(...known))} mm`);
    const ball = this.marks.find(({ kind }) => kind === "ball");
    const crop = this.marks.find(({ kind }) => kind === "crop");
    try {
      if (known.length >= 3) {
        this.shape = { kind: "plane", ...fitPlane(known) };
        lines.push(`plane of ${known.length} points: RMS ${number(this.shape.rms)} mm, tilted ${this.shape.tilt.toFixed(2)} degrees`);
      }
      if (ball) {
        const reach = Math.hypot(ball.b[0] - ball.a[0], ball.b[1] - ball.a[1]);
        const within = (share) => this.pointsWhere((x, y) => Math.hypot(x - ball.a[0], y - ball.a[1]) <= share * reach);
        const [inside, sure] = [within(1), within(0.5)];
        if (sure.length < 10) throw new Error("too few points are in the circle: draw a larger one");
        this.shape = { kind: "sphere", ...fitSphere(inside, sure) };
        const { radius, centre, used } = this.shape;
        lines.push(`sphere: diameter ${number(2 * radius)} mm, centre ${centre.map(number).join(", ")} mm`);
        lines.push(`${used} of ${inside.length} points, RMS ${number(this.shape.rms)} mm`);
      }
    } catch (error) {
      lines.push(error.message);
    }
    if (crop) {
      const inside = this.pointsWhere((x, y) => x >= crop.a[0] && x <= crop.b[0] && y >= crop.a[1] && y <= crop.b[1]);
      if (inside.length) {
        this.box = [0, 1, 2].map((axis) => percentiles(inside.map((point) => point[axis]), [0, 1]));
        const corner = (end) => this.box.map((side) => (end ? Math.ceil(side[1]) : Math.floor(side[0])));
        lines.push(`--crop ${[...corner(0), ...corner(1)].join(" ")}`);
      } else lines.push("nothing is measured in the rectangle");
    }
    return lines;
  }

  // The section along a line: distance from its begin across the view, and depth.
  section({ a, b }) {
    const count = Math.max(2, Math.ceil(Math.hypot(b[0] - a[0], b[1] - a[1]) / this.frame.step));
    const curve = { x: [], y: [] };
    const places = this.frame.arrays.points;
    const depth = this.values("depth");
    let first = null;
    for (let i = 0; i <= count; i++) {
      const at = this.index({ a: [0, 1].map((axis) => Math.round(a[axis] + ((b[axis] - a[axis]) * i) / count)) });
      if (!Number.isFinite(depth[at])) {
        curve.x.push(curve.x.at(-1) ?? 0);
        curve.y.push(NaN);
        continue;
      }
      const [x, y] = places ? [places[3 * at], places[3 * at + 1]] : this.pixel(at);
      first ??= [x, y];
      curve.x.push(Math.hypot(x - first[0], y - first[1]));
      curve.y.push(depth[at]);
    }
    return curve;
  }

  // Drawing.

  redraw() {
    if (!this.frame) return;
    const lines = this.measure();
    this.listFields();
    element("measured").textContent = lines.join("\n") || "Click a point: its place; two: their distance; three: a plane.";
    const { width, height, arrays, step, faces } = this.frame;
    if (width) {
      const size = this.about.size;
      const seen = arrays.picture ?? arrays.texture;
      if (seen) {
        const rgba = opaque(seen);
        if (element("clipped").checked && arrays.picture) markClipped(rgba);
        this.picture.show(rgba, width, height, size);
      }
      const name = element("field").value;
      const rgba = this.rgba(name);
      if (rgba) this.map.show(rgba, width, height, size);
      this.drawPanes(this.marks);
      const numbers = rgba && this.about.maps[name]?.kind !== "color";
      const bar = document.querySelector(".bar");
      bar.hidden = !numbers;
      if (numbers) drawBar(bar, this.ranges[name], this.lut, this.unit(name));
    }
    this.drawSurface();
    const section = this.marks.find(({ kind }) => kind === "section");
    const plot = element("plot");
    plot.hidden = !section && !this.frame.histogram;
    if (section && width) drawPlot(plot, [this.section(section)], arrays.points ? "along, mm" : "along, px", `depth, ${this.unit("depth")}`);
    else if (this.frame.histogram) drawHistogram(plot, this.frame.histogram);
  }

  drawPanes(marks) {
    const numbered = this.points.length > 1;
    const named = marks.filter((mark) => mark.a).map((mark) => ({ ...mark, text: mark.kind === "point" && numbered ? String(this.points.indexOf(mark) + 1) : "" }));
    this.picture.draw(named);
    this.map.draw(named);
  }

  drawSurface() {
    let places = this.places();
    if (this.box) {
      places = places.slice();
      for (let i = 0; i < places.length; i += 3) {
        const inside = this.box.every(([low, high], axis) => places[i + axis] >= low && places[i + axis] <= high);
        if (!inside) places[i + 2] = NaN;
      }
    }
    const name = element("color").value;
    const rgba = name === CLAY ? null : this.rgba(name);
    const colors = rgba && Uint8Array.from(rgba.filter((_, i) => i % 4 !== 3));
    this.surface.show(places, this.frame.width, this.frame.arrays.faces, colors, element("style").value === "points");
    const marked = this.frame.arrays.points ? this.points.map((mark) => this.point(mark)) : [];
    this.surface.mark(marked.filter((point) => point.every(Number.isFinite)));
  }

  save() {
    this.surface.drawNow();
    const link = document.createElement("a");
    link.download = `${this.about.title.replace(/[^\w.-]+/g, "_")}_${this.frame?.number ?? 0}.png`;
    link.href = this.surface.canvas.toDataURL("image/png");
    link.click();
  }
}

function number(value) {
  return Number.isInteger(value) ? String(value) : value.toFixed(4);
}

function markClipped(rgba) {
  for (let i = 0; i < rgba.length; i += 4) {
    if (Math.max(rgba[i], rgba[i + 1], rgba[i + 2]) === 255) rgba.set([255, 0, 200], i);
  }
}

// Counts of levels, a curve for each colour.
function drawHistogram(plot, counts) {
  const colors = ["#ff5a52", "#4cd964", "#4c9aff"];
  const level = (i) => (255 * (i + 0.5)) / counts[0].length;
  const curves = counts.map((curve, channel) => ({
    x: curve.map((_, i) => level(i)),
    y: curve.map((count) => Math.log10(1 + count)),
    color: colors[channel],
  }));
  drawPlot(plot, curves, "level of 255", "pixels, log10");
}

const viewer = new Viewer(document.getElementById("about") ? new PackedFrames() : new ServedFrames());
viewer.start().catch((error) => viewer.say(error.message));
