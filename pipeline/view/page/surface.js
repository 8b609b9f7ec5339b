"use strict";
// The surface in three dimensions, in the camera's frame: x right, y down, z away from it.

// Between neighbouring pixels depth changes by less than this many times what most change by; else it is a step.
const STEP = 4;

class Surface {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: drawnByGpu(), preserveDrawingBuffer: true });
    this.renderer.setClearColor(0x2a3038);
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(30, 1, 1, 1e6);
    this.camera.up.set(0, -1, 0);
    this.scene.add(new THREE.AmbientLight(0xffffff, 0.7), this.camera);
    const lamp = new THREE.DirectionalLight(0xffffff, 2.4);
    lamp.position.set(-1, 1, 1); // at the viewer's upper left
    this.camera.add(lamp, lamp.target);
    lamp.target.position.set(0, 0, -1);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.content = null;
    this.marks = null;
    this.places = null; // (N, 3) of the frame's points
    this.drawn = 0;
    this.asked = false;
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  // Show points (N, 3), a grid `width` wide or vertices of `faces`; `colors` is RGB (N, 3) bytes, or null for clay.
  show(places, width, faces, colors, asPoints) {
    this.places = places;
    if (this.content) {
      this.scene.remove(this.content);
      this.content.geometry.dispose();
      this.content.material.dispose();
    }
    const geometry = new THREE.BufferGeometry();
    const known = compact(places, colors);
    geometry.setAttribute("position", new THREE.BufferAttribute(known.places, 3));
    if (colors) geometry.setAttribute("color", new THREE.BufferAttribute(known.colors, 3, true));
    const color = colors ? 0xffffff : 0xd5ccc0;
    if (asPoints) {
      const material = new THREE.PointsMaterial({ size: 2, sizeAttenuation: false, vertexColors: !!colors, color });
      this.content = new THREE.Points(geometry, material);
    } else {
      const triangles = faces ? faces.map((i) => known.index[i]) : gridFaces(places, width, known.index);
      geometry.setIndex(new THREE.BufferAttribute(triangles, 1));
      geometry.computeVertexNormals();
      const material = new THREE.MeshLambertMaterial({ vertexColors: !!colors, color, side: THREE.DoubleSide });
      this.content = new THREE.Mesh(geometry, material);
    }
    this.scene.add(this.content);
    this.draw();
  }

  // Mark places [[x, y, z], ...].
  mark(places) {
    if (this.marks) this.scene.remove(this.marks);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(Float32Array.from(places.flat()), 3));
    const look = { size: 9, sizeAttenuation: false, color: 0xff3b30, depthTest: false };
    this.marks = new THREE.Points(geometry, new THREE.PointsMaterial(look));
    this.scene.add(this.marks);
    this.draw();
  }

  // Look at all from a side: "front" is the camera's.
  look(from) {
    const bounds = [0, 1, 2].map((axis) => percentiles(this.places.filter((_, i) => i % 3 === axis), [0.01, 0.99]));
    if (!bounds.flat().every(Number.isFinite)) return;
    const middle = new THREE.Vector3(...bounds.map(([low, high]) => (low + high) / 2));
    const aside = { front: [0, 0, -1], side: [-0.75, -0.25, -0.6], top: [0, -1, -0.01] }[from];
    const { camera } = this;
    camera.position.copy(middle).add(new THREE.Vector3(...aside).normalize());
    camera.lookAt(middle);
    camera.updateMatrixWorld();
    // Far enough for every corner of the box, up and down and to both sides.
    const up = Math.tan((camera.fov * Math.PI) / 360);
    const across = (up * this.canvas.clientWidth) / this.canvas.clientHeight;
    let away = 0;
    for (let corner = 0; corner < 8; corner++) {
      const at = camera.worldToLocal(new THREE.Vector3(...bounds.map((ends, axis) => ends[(corner >> axis) & 1])));
      away = Math.max(away, Math.abs(at.x) / across + at.z + 1, Math.abs(at.y) / up + at.z + 1);
    }
    camera.position.sub(middle).multiplyScalar(1.05 * away).add(middle);
    camera.near = away / 100;
    camera.far = away * 20;
    this.controls.target.copy(middle);
    this.controls.update();
    this.draw();
  }

  // Draw before the next picture of the screen, once however often that is asked for.
  draw() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => this.drawNow());
  }

  drawNow() {
    this.asked = false;
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(window.devicePixelRatio || 1);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.renderer.render(this.scene, this.camera);
    this.drawn += 1;
  }

  // The number of the foremost point near a place of the canvas, px; -1: there is none.
  pick(x, y) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const place = new THREE.Vector3();
    let [found, nearest] = [-1, Infinity];
    for (let i = 0; i < this.places.length / 3; i++) {
      if (!Number.isFinite(this.places[3 * i + 2])) continue;
      place.fromArray(this.places, 3 * i).project(this.camera);
      const off = Math.hypot(((place.x + 1) / 2) * width - x, ((1 - place.y) / 2) * height - y);
      if (off > 4 || place.z > 1) continue;
      const score = place.z + off * 1e-4; // of those in reach the foremost
      if (score < nearest) [found, nearest] = [i, score];
    }
    return found;
  }
}

// Whether a GPU draws; without one, smooth edges take three quarters of a picture's time.
function drawnByGpu() {
  const context = document.createElement("canvas").getContext("webgl2");
  const info = context && context.getExtension("WEBGL_debug_renderer_info");
  const name = info ? context.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  return !/swiftshader|llvmpipe|softpipe|basic render/i.test(name);
}

// Points without those that are not known, and where each of all is among them (-1: nowhere).
function compact(places, colors) {
  const count = places.length / 3;
  const index = new Int32Array(count).fill(-1);
  let n = 0;
  for (let i = 0; i < count; i++) if (Number.isFinite(places[3 * i + 2])) index[i] = n++;
  const known = { index, places: new Float32Array(3 * n), colors: colors && new Uint8Array(3 * n) };
  for (let i = 0; i < count; i++) {
    if (index[i] < 0) continue;
    for (let axis = 0; axis < 3; axis++) {
      known.places[3 * index[i] + axis] = places[3 * i + axis];
      if (colors) known.colors[3 * index[i] + axis] = colors[3 * i + axis];
    }
  }
  return known;
}

// Two triangles for every four pixels that belong to one surface.
function gridFaces(places, width, index) {
  const height = places.length / 3 / width;
  const depth = (i) => places[3 * i + 2];
  const steps = [];
  for (let i = 0; i + width < places.length / 3; i += 3) steps.push(Math.abs(depth(i + width) - depth(i)));
  const most = STEP * percentiles(steps, [0.95])[0];
  const faces = new Uint32Array(6 * (width - 1) * (height - 1));
  let n = 0;
  const add = (a, b, c) => {
    const [p, q, r] = [depth(a), depth(b), depth(c)];
    if (!(Math.max(p, q, r) - Math.min(p, q, r) <= most)) return; // nor is a NaN
    faces[n++] = index[a];
    faces[n++] = index[b];
    faces[n++] = index[c];
  };
  for (let y = 0; y + 1 < height; y++) {
    for (let x = 0; x + 1 < width; x++) {
      const a = y * width + x;
      add(a, a + 1, a + width);
      add(a + 1, a + width + 1, a + width);
    }
  }
  return faces.slice(0, n);
}
