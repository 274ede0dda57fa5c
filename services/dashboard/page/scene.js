// The 3D scene: robot, pads lit by signal, the arm at the fused pose with its covariance, what each sense says, and the truth.

import { $, Rate, make, onScheme, put, style, swatch } from "./format.js";
import { Orbit } from "./orbit.js";
import { colour, level } from "./pads.js";
import * as THREE from "./vendor/three.module.js";

const SIGMAS = 2;  // half axes of the ellipsoid that is drawn
const LAYERS = { fused: "fused", covariance: `${SIGMAS} σ`, vision: "vision", haptic: "haptic", truth: "truth" };
const EDGE_ANGLE = 24;

export class SceneView {
  #renderer = null;
  #links = new Map();
  #joints = [];
  #pads = new Map();
  #targets = new Map();
  #isDirty = false;
  #rate = new Rate();
  #schemed = [];
  #eye = null;
  #waits = false;

  // Whether there is WebGL; without it the page goes on with its tables.
  get isThere() {
    return this.#renderer !== null;
  }

  constructor() {
    const canvas = $("space");
    try {
      this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    } catch {
      canvas.hidden = true;
      for (const id of ["layers", "reset-view", "scene-hint"]) $(id).hidden = true;
      $("no-webgl").hidden = false;
      return;
    }
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.02, 60);
    this.camera.up.set(0, 0, 1);
    this.orbit = new Orbit(canvas, () => this.#touch());
    $("reset-view").addEventListener("click", () => this.orbit.reset());
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x5a616c, 1.5));
    const sun = new THREE.DirectionalLight(0xffffff, 2.4);
    sun.position.set(1.2, -1.6, 2.4);
    this.scene.add(sun);
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this.#touch());
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
    onScheme(() => this.#paint());
  }

  describe(scene, buffer, at) {
    if (!this.isThere) return;
    this.senses = scene.senses;
    const meshes = Object.fromEntries(Object.entries(scene.meshes).map(([name, where]) => [name, geometry(buffer, at, where)]));
    const root = new THREE.Group();
    this.scene.add(root);
    root.add(this.#ground());
    this.#links.set("world", root);
    for (const [name, link] of Object.entries(scene.links)) this.#addLink(name, link);
    for (const [name, shape] of Object.entries(meshes)) {
      const [kind, ...rest] = name.split("/");
      if (kind === "link") this.#links.get(rest.join("/")).add(new THREE.Mesh(shape, this.#material("link", { flatShading: true })));
      else this.#addTarget(rest[0], shape);
    }
    for (const [name, pad] of Object.entries(scene.pads)) this.#addPad(name, pad);
    for (const each of Object.values(scene.cameras)) this.scene.add(this.#frustum(each));
    this.#makeLayers(scene);
    this.#paint();
    this.#eye = Object.values(scene.cameras)[0]?.pose;
    this.#waits = scene.robots.length > 0;
  }

  show(moment) {
    if (!this.isThere) return;
    for (const { group, link, robot } of this.#joints) {
      const q = moment.joints[robot]?.[link.joint];
      if (q !== undefined) move(group, link, q);
    }
    for (const [name, volts] of Object.entries(moment.pads)) {
      const [r, g, b] = colour(level(Math.max(...volts)));
      this.#pads.get(name)?.color.setRGB(r / 255, g / 255, b / 255, THREE.SRGBColorSpace);
    }
    for (const [name, now] of Object.entries(moment.targets)) this.#showTarget(this.#targets.get(name), now);
    const isPlaced = !this.#waits || Object.keys(moment.joints).length > 0;
    if (!this.orbit.first && this.#targets.size && isPlaced) this.#frame();
    this.#isDirty = true;
  }

  // Draws where something changed; returns whether it did.
  draw() {
    if (!this.#isDirty || !this.isThere || !this.orbit.first) return;
    this.#isDirty = false;
    this.orbit.apply(this.camera);
    this.#renderer.render(this.scene, this.camera);
    this.#rate.tick();
    put($("scene-rate"), `${this.#rate.perSecond.toFixed(0)} frames/s`);
  }

  #touch() {
    if (this.#isDirty) return;
    this.#isDirty = true;
    requestAnimationFrame(() => this.draw());
  }

  #resize() {
    const { clientWidth, clientHeight } = $("space").parentElement;
    if (!clientWidth || !clientHeight) return;
    this.#renderer.setPixelRatio(Math.min(2, devicePixelRatio));
    this.#renderer.setSize(clientWidth, clientHeight, false);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.#touch();
  }

  // A material whose colour is a variable of the style, so that it follows the scheme.
  #material(variable, options = {}) {
    const material = new THREE.MeshLambertMaterial(options);
    this.#schemed.push([material, variable]);
    return material;
  }

  #lines(variable, options = {}) {
    const material = new THREE.LineBasicMaterial(options);
    this.#schemed.push([material, variable]);
    return material;
  }

  #paint() {
    for (const [material, variable] of this.#schemed) material.color.set(style(variable));
    this.#touch();
  }

  #ground() {
    const points = [];
    for (let i = -8; i <= 8; i++) {
      const a = i / 8;
      points.push(a, -1, 0, a, 1, 0, -1, a, 0, 1, a, 0);
    }
    const group = new THREE.Group();
    group.add(new THREE.LineSegments(segments(points), this.#lines("grid")));
    group.add(new THREE.AxesHelper(0.12));
    group.position.z = -0.001;
    return group;
  }

  #frustum({ pose, size, angle }) {
    const depth = 0.16, h = depth * Math.tan(angle / 2), w = (h * size[0]) / size[1];
    const corners = [[-w, -h], [w, -h], [w, h], [-w, h]];
    const points = corners.flatMap(([x, y], i) => {
      const [u, v] = corners[(i + 1) % 4];
      return [0, 0, 0, x, y, depth, x, y, depth, u, v, depth];
    });
    const lines = new THREE.LineSegments(segments(points), this.#lines("quiet"));
    place(lines, pose);
    return lines;
  }

  // A link hangs on its parent: its joint alone says where it is.
  #addLink(name, link) {
    const group = new THREE.Group();
    place(group, link.pose);
    (this.#links.get(link.parent) ?? this.scene).add(group);
    this.#links.set(name, group);
    if (link.joint !== null) this.#joints.push({ group, link, robot: name.split("/")[0] });
  }

  #addPad(name, { link, pose, size }) {
    const material = new THREE.MeshBasicMaterial();
    const mesh = new THREE.Mesh(new THREE.BoxGeometry(size[0], size[1], 0.003), material);
    place(mesh, pose);
    this.#links.get(link).add(mesh);
    this.#pads.set(name, material);
    material.color.setRGB(...colour(0).map((each) => each / 255), THREE.SRGBColorSpace);
  }

  #addTarget(name, shape) {
    const edges = new THREE.EdgesGeometry(shape, EDGE_ANGLE);
    const sense = (variable) => {
      const group = new THREE.Group();
      group.add(new THREE.LineSegments(edges, this.#lines(variable)));
      group.visible = false;
      this.scene.add(group);
      return group;
    };
    const fused = new THREE.Group();
    fused.add(new THREE.Mesh(shape, this.#material("fused", { transparent: true, opacity: 0.62 })));
    const ball = new THREE.Mesh(new THREE.SphereGeometry(1, 32, 20), this.#material("sigma", { transparent: true, opacity: 0.6, depthWrite: false, depthTest: false }));
    ball.renderOrder = 1;  // inside the arm, and shown through it
    const truth = new THREE.Group();
    truth.add(new THREE.Mesh(shape, this.#material("truth", { transparent: true, opacity: 0.25, depthWrite: false })));
    truth.add(new THREE.LineSegments(edges, this.#lines("truth")));
    for (const object of [fused, ball, truth]) {
      object.visible = false;
      this.scene.add(object);
    }
    this.#targets.set(name, { fused, ball, truth, senses: new Map(), make: sense });
  }

  #showTarget(parts, now) {
    if (!parts) return;
    const isKnown = now.state === "tracking" || now.state === "coasting";
    const layer = (name) => $(`layer-${name}`)?.checked ?? true;
    parts.fused.visible = isKnown && layer("fused");
    parts.ball.visible = isKnown && layer("covariance");
    if (isKnown) {
      place(parts.fused, now.pose);
      parts.fused.children[0].material.color.set(style(now.state === "tracking" ? "fused" : "middling"));
      place(parts.ball, [...now.pose.slice(0, 3), ...now.ellipsoid.orientation]);
      parts.ball.scale.set(...now.ellipsoid.radii.map((radius) => Math.max(0.001, SIGMAS * radius)));
    }
    parts.truth.visible = Boolean(now.truth) && layer("truth");
    if (now.truth) place(parts.truth, now.truth.pose);
    for (const [name, said] of Object.entries(now.senses ?? {})) {
      if (!parts.senses.has(name)) parts.senses.set(name, parts.make(said.sense));
    }
    let isNew = false;
    for (const [name, object] of parts.senses) {
      const said = now.senses?.[name];
      object.visible = Boolean(said?.pose) && layer(said.sense);
      if (object.visible) place(object, said.pose);
      isNew ||= !object.isPainted;
      object.isPainted = true;
    }
    if (isNew) this.#paint();
  }

  #makeLayers(scene) {
    const names = ["fused", "covariance", ...scene.senses, ...(scene.is_simulated ? ["truth"] : [])];
    for (const name of names) {
      const box = make("input", { type: "checkbox", id: `layer-${name}`, checked: true });
      box.addEventListener("change", () => this.#touch());
      $("layers").append(make("label", {}, box, swatch(`var(--${name === "covariance" ? "sigma" : name})`), LAYERS[name]));
    }
  }

  // The first view, once everything has its place: from where the first camera is, wide enough for robots, pads and targets.
  #frame() {
    this.scene.updateMatrixWorld(true);
    const box = new THREE.Box3();
    for (const { fused } of this.#targets.values()) if (fused.visible) box.expandByObject(fused);
    for (const [name, group] of this.#links) if (name !== "world") box.expandByObject(group);
    for (const child of this.#links.get("world").children) if (child.isMesh) box.expandByObject(child);
    const ball = box.getBoundingSphere(new THREE.Sphere());
    const { x, y, z } = ball.center;
    const [right, back, up] = this.#eye ? [this.#eye[0] - x, this.#eye[1] - y, this.#eye[2] - z] : [0.4, -1, 0.5];
    const height = Math.min(0.9, Math.max(0.35, Math.atan2(up, Math.hypot(right, back))));
    this.orbit.set([x, y, z], Math.atan2(back, right) + 0.35, height, Math.max(0.8, 2.2 * ball.radius));
  }
}

function geometry(buffer, start, { at, vertices, faces }) {
  const out = new THREE.BufferGeometry();
  const begin = start + 4 * at;
  out.setAttribute("position", new THREE.BufferAttribute(new Float32Array(buffer, begin, 3 * vertices), 3));
  out.setIndex(new THREE.BufferAttribute(new Uint32Array(buffer, begin + 12 * vertices, 3 * faces), 1));
  out.computeVertexNormals();
  return out;
}

function segments(points) {
  return new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
}

// Puts a link to where its joint's angle [rad] or displacement [m] has it; see `_links` in scene.py.
export function move(object, { pose, axis, slides }, q) {
  const along = new THREE.Vector3(...axis);
  place(object, pose);
  if (slides) object.translateOnAxis(along, q);
  else object.rotateOnAxis(along, q);
}

export function place(object, [x, y, z, ...q]) {
  object.position.set(x, y, z);
  object.quaternion.set(...q);
}
