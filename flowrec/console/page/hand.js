// Steering by hand: the left stick of a gamepad, or keys, for as long as a dead-man's button is held. Samples go through
// the connection of the page (console.js), 50 a second. Whatever ends steering, it begins again with another press only.
"use strict";

const PERIOD_MS = 20;
const DEAD_ZONE = 0.12; // of a stick: it does not return to its middle exactly
const QUEUED_BYTES = 2000; // in the connection; beyond, samples would be old when they arrive
const SHOULDER = 5; // RB or R1 of a gamepad with the standard mapping; of others button 0
const WAYS = {
  KeyW: [0, -1], KeyA: [-1, 0], KeyS: [0, 1], KeyD: [1, 0],
  ArrowUp: [0, -1], ArrowLeft: [-1, 0], ArrowDown: [0, 1], ArrowRight: [1, 0],
};
const HELP = part("hand").innerHTML;

let by = ""; // what steers; "": nothing does
let presses = 0;
let spent = false; // this press steers no longer
let shift = false;
const down = new Set(); // keys, by their place on the keyboard

function bounded(x, y, least = 0) {
  const length = Math.hypot(x, y);
  const share = Math.min(Math.max((length - least) / (1 - least), 0), 1);
  return length > 0 ? [(share * x) / length, (share * y) / length] : [0, 0];
}

function wanted() {
  for (const pad of navigator.getGamepads()) {
    if (!pad?.connected) continue;
    if (pad.buttons[pad.mapping === "standard" ? SHOULDER : 0]?.pressed) {
      return { by: "gamepad", way: bounded(pad.axes[0], pad.axes[1], DEAD_ZONE) };
    }
  }
  if (!shift) return null;
  const ways = [...down].map((code) => WAYS[code]);
  return { by: "keys", way: bounded(...[0, 1].map((axis) => ways.reduce((sum, way) => sum + way[axis], 0))) };
}

function isOpen() {
  return socket !== null && socket.readyState === WebSocket.OPEN;
}

function letGo(why) {
  if (by !== "" && isOpen()) socket.send(JSON.stringify({ command: "hand", number: "hand", held: false, why }));
  by = "";
  part("hand").classList.remove("on");
  part("hand").innerHTML = HELP;
}

function steer() {
  const hand = wanted();
  const barred = document.hidden ? "the page was hidden" : !isOpen() ? "no connection" : ended ? "the end" : "";
  if (hand === null || barred || (by !== "" && hand.by !== by)) {
    letGo(barred || `the button was released (${by})`);
    spent = hand !== null;
    return;
  }
  if (spent || socket.bufferedAmount > QUEUED_BYTES) return;
  if (by === "") {
    presses += 1;
    by = hand.by;
  }
  const [x, y] = hand.way;
  part("hand").classList.add("on");
  part("hand").textContent = `By hand (${by}): ${Math.round(100 * Math.hypot(x, y))} % of the speed limit`;
  socket.send(JSON.stringify({ command: "hand", number: "hand", held: true, x, y, by, press: presses }));
}

function handAnswered(refusal) {
  if (!refusal || by === "") return; // of a press that is over
  letGo(refusal);
  spent = true;
  alarm(`Not steered by hand: ${refusal}`);
}

document.addEventListener("keydown", (event) => {
  if (event.target instanceof HTMLInputElement || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "Shift") shift = true;
  else if (event.code in WAYS) down.add(event.code);
  else return;
  if (shift) event.preventDefault(); // the arrows would scroll
  if (!event.repeat) steer();
});
document.addEventListener("keyup", (event) => {
  if (event.key === "Shift") shift = false;
  else if (!down.delete(event.code)) return;
  steer();
});
window.addEventListener("blur", () => {
  shift = false; // its release is told to another window
  down.clear();
  steer();
});
document.addEventListener("visibilitychange", steer);
window.addEventListener("pagehide", () => letGo("the page was closed"));
setInterval(steer, PERIOD_MS);
