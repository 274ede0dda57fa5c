// What `penumbra sim` steers, as sliders.

import { $, percent, put } from "./format.js";

const SETTLE_MS = 1500;  // after a touch a control shows what the user set, not what the emulator last said
const WAIT_MS = 80;

export class Controls {
  #touched = new Map();
  #waiting = new Map();
  #paused = false;
  #inputs = ["occlusion", "occlusion-auto", "speed", "motion", "pause"].map($);

  constructor(link) {
    this.link = link;
    $("occlusion").addEventListener("input", ({ target }) => {
      this.#touch("occlusion");
      $("occlusion-auto").checked = false;
      put($("occlusion-now"), `${target.value} %`);
      this.#soon("occlude", target.value / 100);
    });
    $("occlusion-auto").addEventListener("change", ({ target }) => {
      this.#touch("occlusion");
      this.#soon("occlude", target.checked ? "auto" : $("occlusion").value / 100);
    });
    $("speed").addEventListener("input", ({ target }) => {
      this.#touch("speed");
      put($("speed-now"), `${(+target.value).toFixed(1)} ×`);
      this.#soon("speed", +target.value);
    });
    $("motion").addEventListener("change", ({ target }) => {
      this.#touch("motion");
      this.#soon("motion", target.checked ? "on" : "off");
    });
    $("pause").addEventListener("click", () => this.#soon(this.#paused ? "resume" : "pause"));
    link.addEventListener("hello", ({ detail }) => this.#allow(detail));
    link.addEventListener("slow", ({ detail }) => this.#show(detail.emulator));
  }

  describe(scene) {
    $("steer").hidden = !scene.is_simulated;
  }

  #allow({ may_steer, look_only }) {
    for (const input of this.#inputs) input.disabled = !may_steer;
    $("steer-why").hidden = may_steer;
    put($("steer-why"), may_steer ? "" : `Looking only: ${look_only || "this key does not steer"}.`);
  }

  #touch(name) {
    this.#touched.set(name, performance.now());
  }

  #isFree(name) {
    return performance.now() - (this.#touched.get(name) ?? -Infinity) > SETTLE_MS;
  }

  // A slider that is dragged asks at most every WAIT_MS, and always for its last value.
  #soon(command, value) {
    const isWaiting = this.#waiting.has(command);
    this.#waiting.set(command, value);
    if (!isWaiting) setTimeout(() => this.#ask(command), WAIT_MS);
  }

  async #ask(command) {
    const value = this.#waiting.get(command);
    this.#waiting.delete(command);
    try {
      this.#show(await this.link.ask("emulator", { command, value }));
      put($("steer-said"), "");
    } catch (error) {
      put($("steer-said"), error.message);
    }
  }

  #show(now) {
    if (!now) return;
    const isAuto = now.occlusion === "auto";
    const hides = percent(now.occlusion_now);
    if (this.#isFree("occlusion")) {
      $("occlusion-auto").checked = isAuto;
      $("occlusion").value = 100 * (isAuto ? now.occlusion_now : now.occlusion);
      put($("occlusion-now"), hides);
    }
    if (this.#isFree("speed")) {
      $("speed").value = now.speed;
      put($("speed-now"), `${now.speed.toFixed(1)} ×`);
    }
    if (this.#isFree("motion")) $("motion").checked = now.motion === "on";
    this.#paused = now.paused;
    put($("pause"), now.paused ? "Resume" : "Pause");
    $("pause").setAttribute("aria-pressed", `${now.paused}`);
    put($("steer-now"), `seed ${now.seed} · scene ${now.scene_s.toFixed(0)} s`);
  }
}
