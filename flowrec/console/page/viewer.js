// Starts Rerun's web viewer, which reads the recording from this page's own address.
"use strict";

const words = document.getElementById("words");

async function start() {
  await wasm_bindgen({ module_or_path: "/rerun/re_viewer_bg.wasm" });
  const viewer = new wasm_bindgen.WebHandle({
    url: [`rerun+http://${location.host}/proxy`],
    render_backend: new URLSearchParams(location.search).get("renderer"),
    hide_welcome_screen: true,
    enable_history: false,
    notebook: false,
    persist: false,
    theme: "dark",
  });
  await viewer.start(document.getElementById("rerun"));
  document.body.dataset.started = "yes";
  words.remove();
}

start().catch((error) => {
  words.textContent = `Rerun's viewer does not start here: ${error}`;
});
