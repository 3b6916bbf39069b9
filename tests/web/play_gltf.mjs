// Prints where three.js puts the vertices of the meshes of a file at the given times: play_gltf.mjs FILE TIME...
import fs from "fs";
import { AnimationMixer, Vector3 } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

globalThis.self = globalThis;
const [file, ...times] = process.argv.slice(2);
const bytes = fs.readFileSync(file);
const gltf = await new GLTFLoader().parseAsync(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length), "");
const mixer = new AnimationMixer(gltf.scene);
for (const clip of gltf.animations) {
  const action = mixer.clipAction(clip);
  action.clampWhenFinished = true;
  action.setLoop(2200, 1); // LoopOnce
  action.play();
}
const frames = times.map((time) => {
  mixer.setTime(Number(time));
  gltf.scene.updateMatrixWorld(true);
  const places = [];
  gltf.scene.traverse((node) => {
    if (!node.isMesh) return;
    if (node.isSkinnedMesh) node.skeleton.update();
    const place = new Vector3();
    for (let index = 0; index < node.geometry.attributes.position.count; index++) {
      node.getVertexPosition(index, place).applyMatrix4(node.matrixWorld);
      places.push(place.toArray());
    }
  });
  return places;
});
console.log(JSON.stringify(frames));
