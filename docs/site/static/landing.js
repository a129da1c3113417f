// Puts the live scene over its still picture, which stays where scripts or WebGL2 are off. It waits until the page
// itself has loaded.
"use strict";

addEventListener("load", () => {
  const stage = document.getElementById("scene");
  if (!document.createElement("canvas").getContext("webgl2")) return;
  const frame = document.createElement("iframe");
  frame.title = "A scene of Gaussians; click it and turn it with the arrow keys";
  frame.src = stage.dataset.page;
  frame.addEventListener("load", () => document.documentElement.classList.add("live"));
  stage.append(frame);
});
