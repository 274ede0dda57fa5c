// Puts the page together: one link, one scene, and a view for each part of the page.

import { CameraView } from "./camera.js";
import { Charts } from "./charts.js";
import { Controls } from "./controls.js";
import { $, put } from "./format.js";
import { Link, unpack } from "./link.js";
import { PadsView } from "./pads.js";
import { PoseView } from "./pose.js";
import { ProcessesView } from "./processes.js";
import { SceneView } from "./scene.js";
import { TimelineView } from "./timeline.js";

const WORDS = { waiting: "connecting", open: "live", closed: "not connected, trying again", stranger: "a key is needed" };

const link = new Link();
const camera = new CameraView(link);
const charts = new Charts(link);
const controls = new Controls(link);
const pads = new PadsView();
const pose = new PoseView();
new ProcessesView(link);
const scene = new SceneView();
const timeline = new TimelineView(link);
let described = null;

link.addEventListener("state", ({ detail }) => {
  put($("link"), WORDS[detail]);
  $("link").dataset.state = detail;
  $("door").hidden = detail !== "stranger";
  $("main").hidden = detail === "stranger";
});

link.addEventListener("hello", () => {
  described ??= describe().catch((error) => {
    described = null;
    put($("link"), error.message);
  });
});

link.addEventListener("slow", () => link.shown("slow"));

link.addEventListener("moment", ({ detail }) => {
  requestAnimationFrame(() => {
    if (pose.target) {
      pose.show(detail, timeline.why(pose.target));
      pads.show(detail);
      charts.show(detail, pose.target);
      timeline.show(detail, pose.target);
      scene.show(detail);
      scene.draw();
    }
    link.shown("moment");
  });
});

$("door").addEventListener("submit", (event) => {
  event.preventDefault();
  link.open($("door-key").value.trim());
});

async function describe() {
  const buffer = await link.fetch("scene");
  const [found, at] = unpack(buffer);
  for (const view of [pose, camera, charts, controls, pads]) view.describe(found);
  scene.describe(found, buffer, at);
  return found;
}

link.start();
