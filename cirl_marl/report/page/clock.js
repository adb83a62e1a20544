// Time: the slider, the play button, and who is told when it moves.

import { part } from "./elements.js";

const QUIET = 1000;
const SMOOTH = 450;
const LONGEST = 20_000;

/** Whether movement is unwelcome. */
export function still() {
  return window.matchMedia("(prefers-reduced-motion: reduce)").matches;
}

/** Starts slider and button over so many labelled steps, 1 to the last; tells a listener each new step. */
export function clockOf(labels, listener) {
  const slider = part("time");
  const button = part("play");
  let running = 0;
  slider.max = labels.length;
  const show = () => {
    const label = labels[slider.value - 1];
    part("now").textContent = label;
    slider.setAttribute("aria-valuetext", label);
    listener(Number(slider.value));
  };
  const stop = () => {
    window.clearInterval(running);
    running = 0;
    button.textContent = "▶";
    button.setAttribute("aria-label", "Play");
  };
  const go = (step) => {
    slider.value = step;
    show();
  };
  const play = () => {
    if (Number(slider.value) === labels.length) go(1);
    button.textContent = "❚❚";
    button.setAttribute("aria-label", "Pause");
    const pace = still() ? QUIET : Math.min(SMOOTH, LONGEST / labels.length);
    running = window.setInterval(() => {
      go(Number(slider.value) + 1);
      if (Number(slider.value) === labels.length) stop();
    }, pace);
  };
  slider.addEventListener("input", () => {
    stop();
    show();
  });
  button.addEventListener("click", () => (running ? stop() : play()));
  document.addEventListener("visibilitychange", () => document.hidden && running && stop());
  return { go, show };
}
