// The page of the console. It shows the latest state that its server sends and asks for what a person wants; what has
// happened is told by the run itself, never by this page.
"use strict";

const facts = JSON.parse(document.body.dataset.facts);
const part = (id) => document.getElementById(id);
const PATIENCE_MS = 1500; // for the run to answer a command
const STALE_MS = 2500; // without a tick of the run
const TRAIL = 40; // states
const MOST_EVENTS = 100;

let socket = null;
let asked = 0; // number of the latest command
let ended = false;
let heardMs = performance.now();
let step = { width: 640, height: 512, um_per_px: 1, radius: 10 };
let trail = [];
const waiting = new Map(); // by number: the timer of a command without an answer

// ---- commands

function command(name, values = {}) {
  if (ended || socket === null || socket.readyState !== WebSocket.OPEN) {
    alarm("Not sent: this page has no connection to the run. Use the keys in the terminal (! takes the field away).");
    return;
  }
  asked += 1;
  const number = asked;
  socket.send(JSON.stringify({ command: name, number, ...values }));
  const late = () => alarm("The run does not answer. Use the keys in the terminal (! takes the field away).");
  waiting.set(number, setTimeout(late, PATIENCE_MS));
}

function answered(number, refusal) {
  clearTimeout(waiting.get(number));
  waiting.delete(number);
  alarm(refusal ? `Refused: ${refusal}` : "");
  if (refusal) place(part("asked"), null);
}

function alarm(text) {
  if (!ended) {
    part("alert").textContent = text;
    part("alert").hidden = text === "";
  }
}

function press(row) {
  if (row.name === "note") {
    part("note").hidden = false;
    part("note-text").focus();
  } else {
    command(row.name);
  }
}

for (const row of facts.commands) {
  const key = row.key === " " ? "space" : row.key;
  const large = row.name === "zero"; // the large one is this command
  const button = large ? part("stop") : document.createElement("button");
  const sign = document.createElement("kbd");
  sign.textContent = key;
  if (large) {
    button.querySelector("span").append(`${row.words} `, sign);
  } else {
    button.type = "button";
    button.dataset.command = row.name;
    button.append(row.words, sign);
    part("keys").append(button);
  }
  button.title = row.meaning;
  button.setAttribute("aria-label", `${large ? "STOP: " : ""}${row.words} (key ${key}). ${row.meaning}`);
  button.addEventListener("click", (event) => {
    if (event.detail > 0) button.blur(); // so that the space bar holds the robot rather than presses this again
    press(row);
  });
}

document.addEventListener("keydown", (event) => {
  if (event.repeat || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target instanceof HTMLInputElement || event.target instanceof HTMLSelectElement) {
    if (event.key === "Escape") dropNote();
    return;
  }
  if (event.key === " " && event.target instanceof HTMLButtonElement) return; // presses that button
  const row = facts.commands.find((each) => each.key === event.key.toLowerCase());
  if (row !== undefined) {
    event.preventDefault();
    press(row);
  }
});

function dropNote() {
  part("note-text").value = "";
  part("note").hidden = true;
}

part("note-text").maxLength = facts.longest_note;
part("note").addEventListener("submit", (event) => {
  event.preventDefault();
  command("note", { text: part("note-text").value });
  dropNote();
});
part("note-drop").addEventListener("click", dropNote);
part("speed").addEventListener("submit", (event) => {
  event.preventDefault();
  command("speed", { limit_um_s: Number(part("speed-value").value) });
  part("speed-value").blur();
});
part("output").addEventListener("submit", (event) => {
  event.preventDefault();
  command("output", { name: part("output-name").value, value: Number(part("output-value").value) });
  part("output-value").blur();
});
part("speed-none").addEventListener("click", () => command("speed", { limit_um_s: null }));

part("drawing").addEventListener("click", (event) => {
  const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(part("drawing").getScreenCTM().inverse());
  if (at.x < 0 || at.y < 0 || at.x > step.width || at.y > step.height) return;
  command("goal", { x_px: at.x, y_px: at.y });
  place(part("asked"), [at.x, at.y], 1.5 * ring());
});

// ---- what is shown

function ring() {
  return step.radius + 0.006 * step.width;
}

function place(circle, at, radius) {
  circle.toggleAttribute("hidden", at === null);
  if (at !== null) {
    circle.setAttribute("cx", at[0]);
    circle.setAttribute("cy", at[1]);
    circle.setAttribute("r", radius);
  }
}

function path(points, close) {
  return `M${points.map((each) => each.join(" ")).join("L")}${close ? "Z" : ""}`;
}

function showDrawing(drawing) {
  step = drawing;
  const { width, height, goal } = drawing;
  part("drawing").setAttribute("viewBox", `0 0 ${width} ${height}`);
  part("frame").style.setProperty("--ratio", width / height);
  part("walls").replaceChildren(
    ...drawing.walls.map((line) => {
      const wall = document.createElementNS("http://www.w3.org/2000/svg", "path");
      wall.setAttribute("d", path(line, true));
      return wall;
    }),
  );
  part("route").setAttribute("points", drawing.route.join(" "));
  part("goal").toggleAttribute("hidden", goal === null);
  part("goal-um").textContent = drawing.goal_um === null ? "none" : `(${drawing.goal_um.join(", ")}) µm`;
  place(part("asked"), null);
  if (goal !== null) {
    const [x, y] = goal;
    const r = 1.5 * ring();
    place(part("goal").querySelector("circle"), goal, r);
    const arms = [[1, 0], [-1, 0], [0, 1], [0, -1]];
    const line = ([dx, dy]) => path([[x + 0.6 * r * dx, y + 0.6 * r * dy], [x + 1.5 * r * dx, y + 1.5 * r * dy]]);
    part("goal").querySelector("path").setAttribute("d", arms.map(line).join(""));
  }
  part("speed-value").max = drawing.top_speed;
  part("speed-value").placeholder = `at most ${Math.round(drawing.top_speed)}`;
  showScale();
}

function showScale() {
  const longest = 0.2 * step.width * step.um_per_px;
  const decade = 10 ** Math.floor(Math.log10(longest));
  const length = decade * (longest >= 5 * decade ? 5 : longest >= 2 * decade ? 2 : 1);
  const [right, bottom] = [0.97 * step.width, 0.96 * step.height];
  const left = right - length / step.um_per_px;
  part("scale").querySelector("path").setAttribute("d", path([[left, bottom], [right, bottom]]));
  const words = part("scale").querySelector("text");
  words.textContent = length >= 1000 ? `${length / 1000} mm` : `${length} µm`;
  words.setAttribute("x", 0.5 * (left + right));
  words.setAttribute("y", bottom - 0.015 * step.height);
  words.setAttribute("font-size", 0.028 * step.width);
}

function showState(state) {
  part("state").textContent = state.waits_for ? `${state.state} (${state.waits_for})` : state.state;
  part("state").classList.toggle("held", state.held);
  const limit = state.duration_s ? ` of ${state.duration_s}` : "";
  part("time").textContent = `${state.time_s.toFixed(1)}${limit} s`;
  part("field").textContent = state.field;
  part("error").textContent = state.error_um === null ? "-" : `${state.error_um} µm`;
  const outputs = state.outputs ?? [];
  if (part("output-name").length !== outputs.length) {
    part("output-name").replaceChildren(...outputs.map((name) => new Option(name)));
    part("output").hidden = outputs.length === 0;
  }
  part("limit").textContent = state.speed_limit_um_s !== null ? `${state.speed_limit_um_s} µm/s` : "none";
  part("losses").textContent = state.losses.length ? state.losses.join(", ") : "none";
  part("losses").classList.toggle("bad", state.losses.length > 0);
  part("disk").textContent = state.disk?.replace("disk ", "") ?? "-";
  part("file").textContent = state.file_mb === undefined ? "-" : `${state.file_mb.toFixed(1)} MB`;
  document.querySelector("[data-command=hold]").classList.toggle("on", state.held);
  document.querySelector("[data-command=end]").disabled = !state.observing || ended;
  place(part("robot"), state.robot, ring());
  part("robot").classList.toggle("unseen", !state.seen);
  showOthers(state.others);
  if (state.robot !== null) trail = [...trail.slice(1 - TRAIL), state.robot];
  part("trail").setAttribute("points", trail.join(" "));
}

function showOthers(others) {
  const drawn = ["circle", "text"].map((name) => document.createElementNS("http://www.w3.org/2000/svg", name));
  const group = part("others");
  while (group.children.length > others.length) group.lastChild.remove();
  while (group.children.length < others.length) {
    const robot = document.createElementNS("http://www.w3.org/2000/svg", "g");
    robot.append(...drawn.map((each) => each.cloneNode()));
    group.append(robot);
  }
  others.forEach(({ number, at, colour, seen, near }, index) => {
    const robot = group.children[index];
    const [circle, words] = robot.children;
    robot.classList.toggle("unseen", !seen);
    robot.classList.toggle("near", near);
    circle.style.stroke = seen ? colour : "";
    place(circle, at, ring());
    words.toggleAttribute("hidden", at === null);
    words.textContent = number;
    if (at !== null) {
      words.setAttribute("x", at[0] + 1.3 * ring());
      words.setAttribute("y", at[1] - 0.8 * ring());
      words.setAttribute("font-size", 0.028 * step.width);
    }
  });
}

function showEvents(events) {
  const list = part("events");
  for (const event of events) {
    const line = document.createElement("li");
    const time = document.createElement("time");
    time.textContent = `${event.s.toFixed(2)} s`;
    line.className = event.level;
    line.append(time, event.text);
    list.prepend(line); // the latest is on top
  }
  while (list.children.length > MOST_EVENTS) list.lastChild.remove();
}

async function showPicture(data) {
  const every = new Uint8Array(data, 0, 1)[0]; // each n-th row and column was sent
  const image = await createImageBitmap(new Blob([data.slice(1)], { type: "image/jpeg" }));
  const canvas = part("picture");
  if (canvas.width !== image.width || canvas.height !== image.height) {
    canvas.width = image.width;
    canvas.height = image.height;
  }
  // A pixel that was sent is drawn as large as those that it stands for, and in their middle.
  const [across, down] = [image.width / step.width, image.height / step.height];
  const shift = 0.5 * (1 - every);
  const size = [image.width * every * across, image.height * every * down];
  canvas.getContext("2d").drawImage(image, shift * across, shift * down, ...size);
  image.close();
}

function showEnd(how) {
  ended = true;
  const [first, ...others] = how.told.length ? how.told : [`The run has ended: ${how.outcome}`];
  const told = [...others, ...(how.files ? [`Recorded in ${how.files}`] : [])];
  part("alert").textContent = `${first}.`;
  part("alert").append(...told.map((text) => Object.assign(document.createElement("span"), { textContent: `${text}.` })));
  part("alert").classList.toggle("good", how.good);
  part("alert").classList.toggle("doubtful", how.doubtful);
  part("state").textContent = how.outcome;
  part("field").textContent = "off";
  part("alert").hidden = false;
  for (const button of document.querySelectorAll("aside button, aside input")) button.disabled = true;
  part("hint").textContent = "";
  for (const timer of waiting.values()) clearTimeout(timer);
}

// ---- the connection

function connect() {
  socket = new WebSocket(`ws://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  const begunMs = performance.now();
  socket.onopen = () => alarm("");
  socket.onmessage = ({ data }) => {
    if (typeof data !== "string") {
      showPicture(data);
      return;
    }
    const words = JSON.parse(data);
    if (words.answers === "hand") {
      handAnswered(words.refusal);
      return;
    }
    if ("answers" in words) {
      answered(words.answers, words.refusal);
      return;
    }
    heardMs = performance.now();
    if (words.drawing) showDrawing(words.drawing);
    showEvents(words.events);
    if (words.state.state !== undefined) showState(words.state);
    if (words.ended) showEnd(words.ended);
  };
  socket.onclose = ({ reason }) => {
    if (ended) return;
    alarm(reason || "No connection to the run: nothing on this page reaches it. Use the keys in the terminal.");
    part("state").textContent = "no connection";
    part("events").replaceChildren(); // they come again
    setTimeout(connect, Math.max(0, 1000 - (performance.now() - begunMs)) + 500);
  };
}

setInterval(() => {
  const silentMs = performance.now() - heardMs;
  if (!ended && socket.readyState === WebSocket.OPEN && silentMs > STALE_MS) {
    part("state").textContent = `no news for ${Math.round(silentMs / 1000)} s`;
  }
}, 500);

// ---- Rerun

function show(rerun) {
  part("frame").hidden = rerun;
  part("rerun").hidden = !rerun;
  part("hint").hidden = rerun;
  part("show-camera").setAttribute("aria-pressed", !rerun);
  part("show-rerun").setAttribute("aria-pressed", rerun);
  // Loaded when it is first wanted: it is 43 MB, and draws as long as it is there.
  part("rerun").src = rerun ? "/rerun/" : "about:blank";
}

part("show-camera").addEventListener("click", () => show(false));
part("show-rerun").addEventListener("click", () => show(true));
part("show-rerun").hidden = !facts.rerun;

connect();
